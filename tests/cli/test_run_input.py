import pytest
from memory_drive import MemorySequence

from bevcli.cli import run_input
from bevcli.cli.run_input import FrameChoice, choose_frames, ego_motion_use, frame_range
from bevcli.errors import InputError
from bevcli.sequences.open import InputOptions


@pytest.mark.parametrize(
    ("text", "places"), [(None, [0, 1, 2, 3, 4]), ("1:3", [1, 2]), (":2", [0, 1]), ("3:99", [3, 4]), ("4:", [4])]
)
def test_a_range_counts_places_with_its_end_exclusive_and_clipped(text, places):
    assert list(frame_range(text, 5)) == places


@pytest.mark.parametrize("text", ["5:9", "2:2", "3", "a:b", "-1:2", "1:2:3"])
def test_a_range_without_a_frame_or_a_meaning_is_a_mistake(text):
    with pytest.raises(InputError, match="--frames"):
        frame_range(text, 5)


@pytest.fixture
def fast_drive(monkeypatch):
    """Ten frames at 10 Hz behind any path."""
    drive = MemorySequence(10, step_s=0.1)
    monkeypatch.setattr(run_input, "open_sequence", lambda path, options: drive)
    return drive


def indices(mini_config, tmp_path, options=InputOptions(), **choice):
    drive = choose_frames(tmp_path, options, FrameChoice(**choice), mini_config)
    return [stamp.index for stamp in drive.stamps]


def test_faster_input_is_thinned_to_the_models_rate_unless_told_otherwise(fast_drive, mini_config, tmp_path):
    assert indices(mini_config, tmp_path) == [0, 5]
    assert indices(mini_config, tmp_path, rate="5") == [0, 2, 4, 6, 8]
    assert indices(mini_config, tmp_path, rate="all") == list(range(10))
    assert indices(mini_config, tmp_path, every=4) == [0, 4, 8]
    assert indices(mini_config, tmp_path, rate="5", frames="1:3") == [2, 4]


def test_sweeps_that_were_asked_for_are_not_thinned_away(fast_drive, mini_config, tmp_path):
    sweeps = InputOptions(sweeps=True)
    assert indices(mini_config, tmp_path, sweeps) == list(range(10))
    assert indices(mini_config, tmp_path, sweeps, every=5) == [0, 5]


@pytest.mark.parametrize("choice", [{"rate": "fast"}, {"rate": "-2"}, {"rate": "2", "every": 2}])
def test_a_rate_that_is_none_is_a_mistake(fast_drive, mini_config, tmp_path, choice):
    with pytest.raises(InputError, match="--rate"):
        indices(mini_config, tmp_path, **choice)


def test_thinning_is_said(fast_drive, mini_config, tmp_path):
    notes = choose_frames(tmp_path, InputOptions(), FrameChoice(), mini_config).notes
    assert "2 of 10 frames" in " ".join(notes)


def test_static_goes_before_no_temporal():
    assert ego_motion_use(static=True, temporal=False) == "static"
    assert ego_motion_use(static=False, temporal=False) == "none"
    assert ego_motion_use(static=False, temporal=True) == "required"
