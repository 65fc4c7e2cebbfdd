"""Formats and options are stated once; parts of a sequence; and what calibration.json states about a drive."""

import importlib
import json
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import invoked
from memory_drive import MemoryDrive

from bevcli import registry
from bevcli.errors import BevcliError, InputError
from bevcli.frame import DerivedDrive, Drive, DriveFacts, FrameStamp
from bevcli.geometry.transforms import GeoOrigin
from bevcli.recording import RecordingOptions
from bevcli.sequences import images
from bevcli.sequences.files.calibration_file import draft_calibration
from bevcli.sequences.format import GROUP, format_of, formats
from bevcli.sequences.native import FolderOptions, NativeFolder
from bevcli.sequences.open import DriveView, open_sequence, select_every, select_range, select_rate
from bevcli.sequences.options import InputOptions, RigOptions
from bevcli.workshop.formats.output import NativeWriter

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


START_NS = 1_533_151_603_000_000_000


class MadeDrive(Drive):
    """A sequence of frames at given seconds. `load` returns what tells the frame's position."""

    name, rig, has_ego_motion = "drive", None, True

    def __init__(self, *scenes):
        self.stamps = tuple(
            FrameStamp(index, str(scene), START_NS + round(second * 1e9))
            for scene, seconds in enumerate(scenes)
            for index, second in enumerate(seconds)
        )

    def load(self, place):
        return SimpleNamespace(position=place, ground_truth=None)


def kept(sequence):
    """Positions in the original sequence."""
    return [sequence.load(place).position for place in range(len(sequence.stamps))]


@pytest.mark.parametrize(("rate", "step"), [(12, 6), (10, 5), (4, 2), (30, 15)])
def test_multiple_of_the_rate_is_thinned_evenly(rate, step):
    thinned = select_rate(MadeDrive(np.arange(10 * rate) / rate), 2.0)
    assert kept(thinned) == list(range(0, 10 * rate, step))
    assert f"{len(thinned.stamps)} of {10 * rate} frames" in thinned.notes[0]


def test_jittering_keyframes_are_all_kept():
    rng = np.random.default_rng(1)
    drive = MadeDrive(np.arange(40) * 0.5 + rng.uniform(-0.05, 0.05, 40))
    assert select_rate(drive, 2.0) is drive


def test_each_kept_frame_is_the_nearest_to_a_tick():
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.uniform(0.02, 0.2, 300))
    times -= times[0]
    chosen = times[kept(select_rate(MadeDrive(times), 2.0))]
    nearest = {float(times[np.argmin(np.abs(times - tick))]) for tick in np.arange(0, times[-1] + 0.25, 0.5)}
    assert set(chosen.tolist()) <= nearest
    assert len(chosen) >= len(nearest) - 1


def test_rates_that_do_not_divide_or_are_lower_and_one_frame():
    thinned = select_rate(MadeDrive(np.arange(300) / 7.0), 2.0)
    assert len(thinned.stamps) == pytest.approx(300 / 7 * 2, abs=1.5)
    slower = select_rate(MadeDrive(np.arange(5.0)), 2.0)
    assert kept(slower) == [0, 1, 2, 3, 4]
    assert "1 frames per second" in slower.notes[0]
    assert kept(select_rate(MadeDrive([0.0]), 2.0)) == [0]


def test_hole_in_the_recording_gives_no_extra_frames():
    times = [*np.arange(24) / 12, *(10 + np.arange(24) / 12)]
    chosen = [times[place] for place in kept(select_rate(MadeDrive(times), 2.0))]
    assert chosen == [0, 0.5, 1, 1.5, 10, 10.5, 11, 11.5]


def test_each_scene_is_thinned_from_its_first_frame():
    drive = MadeDrive(np.arange(13) / 12, np.arange(13) / 12 + 100.3)
    assert kept(select_rate(drive, 2.0)) == [0, 6, 12, 13, 19, 25]
    assert kept(select_every(drive, 5)) == [0, 5, 10, 13, 18, 23]


@pytest.mark.parametrize(
    ("frames", "expected"),
    [(slice(None), [0, 1, 2, 3, 4]), (slice(1, 3), [1, 2]), (slice(3, 99), [3, 4]), (slice(-2, None), [3, 4])],
)
def test_range_of_frames(frames, expected):
    assert kept(select_range(MadeDrive(np.arange(5)), frames)) == expected


@pytest.mark.parametrize("frames", [slice(5, 9), slice(2, 2)])
def test_range_without_frames_is_an_error(frames):
    with pytest.raises(InputError, match=r"`frames=\d:\d` .`--frames`.: .*has 5: 0:5"):
        select_range(MadeDrive(np.arange(5)), frames)


def test_range_counts_the_frames_that_are_left_after_thinning(drive):
    """The drive has the frames 10 to 13, two per second."""

    def indices(**options):
        return [stamp.index for stamp in open_sequence(drive, **options).stamps]

    assert indices(rate_hz=1.0) == [10, 12]
    assert indices(rate_hz=1.0, frames=slice(1, 2)) == [12]
    assert indices(every=3) == [10, 13]
    assert indices(rate_hz=2.0) == [10, 11, 12, 13]


@pytest.mark.parametrize("options", [{"rate_hz": 2.0, "every": 2}, {"rate_hz": 0.0}, {"rate_hz": -1.0}, {"every": 0}])
def test_invalid_rate_is_an_error(drive, options):
    with pytest.raises(InputError, match=f"`{next(iter(options))}"):
        open_sequence(drive, **options)


def test_views_of_views_are_one_view_of_the_drive(drive):
    whole = open_sequence(drive)
    view = open_sequence(drive, every=2, frames=slice(1, 2))
    assert view.drive is not None
    assert not isinstance(view.drive, DerivedDrive)
    assert [stamp.index for stamp in view.stamps] == [12]
    assert view.load(0).stamp == whole.load(2).stamp
    assert view.image_files(0) == whole.image_files(2)


def test_a_selection_counts_the_boxes_of_its_frames(drive):
    boxes = [{"class": "Car", "center": [9 + index, 0, 1], "size_lwh": [4, 2, 1.5], "yaw": 0} for index in range(3)]
    frames = [
        {"frame": 10 + index, "timestamp_ns": 10**9 + index * 5 * 10**8, "boxes": boxes[:index]} for index in range(4)
    ]
    content = {"format": "bevcli-boxes/1", "frame_of_reference": "ego", "frames": frames}
    (drive / "ground_truth.json").write_text(json.dumps(content))
    assert open_sequence(drive).class_counts == {"car": 6}
    assert open_sequence(drive, every=2).class_counts == {"car": 2}
    assert open_sequence(drive, frames=slice(3, 4)).class_counts == {"car": 3}


class Reversed(DerivedDrive):
    """A derived drive that states its frames whole."""

    def load(self, index):
        return self.drive.load(len(self.stamps) - 1 - index)


def test_derived_drives_decode_no_image_for_scoring(drive, monkeypatch):
    whole = open_sequence(drive)
    turned = DriveView(whole, rig=replace(whole.rig, ego_from_bev=np.eye(4)))
    assert Reversed(whole).ground_truth_frame(0).stamp.index == 13  # what only states `load`
    monkeypatch.setattr(images, "decode_image", None)  # as each image would be
    for derived in (DerivedDrive(whole), turned, DriveView(turned, [1])):
        assert not derived.ground_truth_frame(0).images
    assert (turned.ground_truth_frame(0).rig.ego_from_bev == np.eye(4)).all()


@pytest.mark.parametrize(
    ("unit_ns", "said"),
    [(1000, r"1000 times too small \(in microseconds"), (10**6, r"1000000 times too small \(in milliseconds")],
)
def test_a_drive_in_another_unit_is_refused(unit_ns, said, drive):
    for file in ("frames.csv", "ego_motion.csv"):
        head, *rows = (drive / file).read_text().splitlines()
        is_time = [name.endswith("timestamp_ns") for name in head.split(",")]
        cells = [zip(is_time, row.split(","), strict=True) for row in rows]
        rows = [",".join(str(int(text) // unit_ns) if time else text for time, text in row) for row in cells]
        (drive / file).write_text("\n".join([head, *rows]))
    for options in ({}, {"rate_hz": 2.0}, {"model_rate_hz": 2.0}):
        with pytest.raises(InputError, match=said):
            open_sequence(drive, **options)


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("1.70000E+18", "its last digits are lost"),
        ("1.700000000500000000E+18", "write 1700000000500000000"),
        ("1700000000.5", "1700000000500000000, if it is in seconds"),
        ("1700000000500.25", "1700000000500250000, if it is in milliseconds"),
        ("1700000000500000000.0", "write 1700000000500000000"),
        ("nan", "write digits only"),
    ],
)
def test_advice_for_a_time_gives_the_right_number(cell, said, edit):
    with pytest.raises(InputError) as error:
        open_sequence(edit("frames.csv", "\n10,1000000000,", f"\n10,{cell},"))
    assert said in str(error.value)
    assert "remove decimal point" not in str(error.value)


MUNICH = DriveFacts(rendered=True, geo_origin=GeoOrigin(48.1374, 11.5755, 60.0))
SAMPLES = Path(__file__).parents[2] / "samples"


def written(folder: Path, facts: DriveFacts | None) -> Path:
    drive = MemoryDrive(3)
    with NativeWriter(folder, with_ego_motion=True, facts=facts) as writer:
        for place in range(3):
            writer.write(replace(drive.load(place), stamp=replace(drive.stamps[place], scene="")))
    return folder


@pytest.mark.parametrize("facts", [MUNICH, DriveFacts(), DriveFacts(geo_origin=GeoOrigin(-33.9, 151.2))])
def test_what_is_written_is_read(tmp_path, facts):
    folder = written(tmp_path / "drive", facts)
    assert open_sequence(folder).facts == facts
    if facts is MUNICH:
        change(folder, geo_origin={"latitude": 1.3, "longitude": 103.8})
        assert open_sequence(folder).facts.geo_origin == GeoOrigin(1.3, 103.8, 90.0)  # the heading is east
        assert open_sequence(SAMPLES / "street").facts.rendered
        assert MemoryDrive(1).facts == DriveFacts()


def test_a_part_of_a_drive_and_a_converted_drive_state_the_same(tmp_path):
    folder = written(tmp_path / "drive", MUNICH)
    assert open_sequence(folder, frames=slice(0, 2)).facts == MUNICH
    invoked("convert", folder, tmp_path / "copy")
    assert open_sequence(tmp_path / "copy").facts == MUNICH


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rendered": "yes"}, '"rendered" is not true or false'),
        ({"geo_origin": [48.1, 11.5]}, '"geo_origin" is not an object'),
        ({"geo_origin": {"latitude": 48.1}}, '"geo_origin.longitude" is missing'),
        ({"geo_origin": {"latitude": 98.1, "longitude": 11.5}}, '"geo_origin.latitude" is out of range'),
        ({"geo_origin": {"latitude": 48.1, "longitude": "east"}}, '"geo_origin.longitude" is not an array of numbers'),
    ],
)
def test_a_mistake_is_one_line_that_names_the_field(tmp_path, changes, message):
    folder = written(tmp_path / "drive", None)
    change(folder, **changes)
    with pytest.raises(InputError) as caught:
        open_sequence(folder)
    assert message in str(caught.value)
    assert draft_calibration(folder / "calibration.json").facts == DriveFacts()


def change(folder: Path, **fields: object) -> None:
    path = folder / "calibration.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))
