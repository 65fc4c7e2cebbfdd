"""Formats and options from Python: each is stated once, what means nothing is refused, a package can add a format."""

import importlib
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from bevcli import registry
from bevcli.errors import BevcliError, InputError
from bevcli.recording import RecordingOptions
from bevcli.sequences.format import GROUP, format_of, formats
from bevcli.sequences.native import FolderOptions, NativeFolder
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions, RigOptions

PLUG_IN = """
from memory_drive import MemoryDrive

from bevcli.options import option, options
from bevcli.sequences.format import Format


@options("Input")
class Strips(Format):
    name = "a strip"
    expected = "name.strip"
    images_per_second: float = option(default=2.0, help="Strips: images per second.")

    @classmethod
    def recognises(cls, path):
        return path.suffix == ".strip"

    def open(self, path, common):
        return MemoryDrive(3, step_s=1 / self.images_per_second)
"""


@pytest.fixture
def plug_in(tmp_path, monkeypatch):
    """A package with a format, installed into a folder of its own."""
    site = tmp_path / "site"
    facts = site / "strips-1.0.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: strips\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text("[bevcli.sequences]\nstrips = strips:Strips\n")
    (site / "strips.py").write_text(PLUG_IN)
    monkeypatch.syspath_prepend(str(site))
    registry.installed.cache_clear()
    registry.entries.cache_clear()
    yield
    sys.modules.pop("strips", None)
    monkeypatch.undo()
    importlib.invalidate_caches()
    registry.installed.cache_clear()
    registry.entries.cache_clear()
    registry.load.cache_clear()


@pytest.fixture
def strip(tmp_path) -> Path:
    (tmp_path / "day.strip").touch()
    return tmp_path / "day.strip"


def test_each_option_is_stated_once():
    common = {field.name for field in fields(InputOptions)}
    shared = {field.name for field in fields(FolderOptions)}  # of a folder and a video; those of a rig are among them
    own = [{field.name for field in fields(one)} for one in formats()]
    assert not common & set().union(*own)
    for number, names in enumerate(own):
        for others in own[number + 1 :]:
            assert names & others <= shared
    assert all(field.metadata["option"].help for kind in (InputOptions, *formats()) for field in fields(kind))


def test_an_option_of_another_format_is_refused_by_name(drive):
    with pytest.raises(InputError, match=r"a sequence folder: .*sweeps.* for a nuScenes root"):
        open_sequence(drive, sweeps=True)
    assert open_sequence(drive, sweeps=False, version=None, topics={}).stamps
    with pytest.raises(TypeError, match="`swept`"):
        open_sequence(drive, swept=True)


def test_options_are_a_dataclass_or_keywords_and_a_model_states_its_rate(drive):
    options = InputOptions(every=2, frames=slice(1, 2))
    by_class = open_sequence(drive, options).stamps
    assert by_class == open_sequence(drive, every=2, frames=slice(1, 2)).stamps
    assert open_sequence(drive, options, frames=None).stamps == open_sequence(drive, every=2).stamps
    for others, count in (({}, 2), ({"rate_hz": "all"}, 4), ({"every": 1}, 4)):  # of four, two a second
        assert len(open_sequence(drive, model_rate_hz=1.0, **others).stamps) == count


def test_the_strongest_format_is_taken(drive, tmp_path):
    assert format_of(drive).name == "a sequence folder"
    shutil.copytree(drive, tmp_path / "both")
    (tmp_path / "both/v1.0-mini").mkdir()
    (tmp_path / "both/v1.0-mini/scene.json").write_text("[]")
    assert format_of(tmp_path / "both").name == "a nuScenes root"


def test_a_package_can_add_a_format(plug_in, strip, drive):
    sequence = open_sequence(strip, images_per_second=4, frames=slice(1, None))
    assert [stamp.timestamp_ns - 10**18 for stamp in sequence.stamps] == [250_000_000, 500_000_000]
    with pytest.raises(InputError, match=r"images.per.second"):
        open_sequence(drive, images_per_second=4)
    with pytest.raises(InputError, match=r"a sequence folder, .*, a strip"):
        open_sequence(drive / "missing")


def test_a_broken_package_stops_only_what_needs_its_format(plug_in, strip, drive):
    (strip.parent / "site/strips.py").write_text("import a_package_that_is_missing")
    assert open_sequence(drive).stamps
    for path, options in ((strip, {}), (drive, {"images_per_second": 4})):
        with pytest.raises(BevcliError, match=r"strips = strips:Strips cannot be imported.*a_package"):
            open_sequence(path, **options)
    assert len(formats()) == len(registry.entries(GROUP)) - 1


def test_recognising_a_path_imports_no_reader(tmp_path):
    code = (
        "import sys; from pathlib import Path; from bevcli.sequences.format import formats\n"
        "[one.recognises(Path(sys.argv[1])) for one in formats()]\n"
        "print(sorted({'numpy', 'mcap', 'rosbags', 'cv2', 'torch'} & set(sys.modules)))"
    )
    shown = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("made", "values", "said"),
    [
        (InputOptions, {"ego_motion": "poses.csv"}, r"`ego_motion=poses.csv` .*a file of poses is `ego_motion_file`"),
        (InputOptions, {"every": "2"}, r"`every=2` \(`--every`\): means nothing \(expected int\)"),
        (InputOptions, {"every": float("nan")}, "`every=nan` .*expected 1 or more"),
        (InputOptions, {"rate_hz": "al"}, r"`rate_hz=al` \(`--rate`\): means nothing \(expected all, float\)"),
        (InputOptions, {"frames": "0:10"}, "`frames=0:10` .*expected slice"),
        (InputOptions, {"odometry": "no"}, "`odometry=no` .*expected bool"),
        (InputOptions, {"classes": "car"}, "`classes=car` .*expected tuple"),
        (RigOptions, {"pose_times": "minutes"}, r"`pose_times=minutes` .*\(expected s, ms, us, ns\)"),
        (NativeFolder, {"times": "x" * 10**6}, "`times=x{1,60}"),
        (NativeFolder, {"image_rate_hz": 0.0}, "`image_rate_hz=0` .*images per second"),  # of the class above it
        (RecordingOptions, {"level": "most"}, "`level=most` .*expected minimal, standard, full"),
        *((RecordingOptions, {"bev": bev}, "expected") for bev in ("channel", "channel:-1", "heat")),
        (RecordingOptions, {"vehicle_mesh": Path("none.glb")}, r"`vehicle_mesh=none\.glb`"),
    ],
)
def test_a_value_that_means_nothing_is_an_error(made, values, said):
    with pytest.raises(InputError, match=said) as told:
        made(**values)
    assert len(str(told.value)) < 250


def test_values_that_mean_something_are_taken():
    made = InputOptions(rate_hz="all", ego_motion="static", scene="a", frames=slice(0, 1))
    assert (made.rate_hz, made.ego_motion) == ("all", "static")
    assert [RecordingOptions(bev=bev).bev for bev in ("norm", "channel:17")] == ["norm", "channel:17"]
    assert RigOptions(height={"front": 1.5}, pose_times="ns", poses_of="vehicle").pose_times == "ns"


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"pose_angles": "degrees"}, "states all of its poses: remove `pose_angles`"),
        ({"pose_times": "s"}, "states all of its poses: remove `pose_times`"),
        ({"ego_motion_file": "none.csv", "ego_motion": "optional"}, "none.csv: the file is missing"),
    ],
)
def test_an_option_that_changes_nothing_is_an_error(drive, stated, said):
    with pytest.raises(InputError, match=said):
        open_sequence(drive, **stated)
