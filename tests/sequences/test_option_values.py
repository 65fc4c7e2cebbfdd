"""Options from Python: a value that means nothing is an error, in every dataclass of options."""

from pathlib import Path

import pytest

from bevcli.errors import InputError
from bevcli.recording import RecordingOptions
from bevcli.sequences.native import NativeFolder
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions, RigOptions


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
