"""Recordings that were cut off are mended; files that are none get one line."""

import pytest
from memory_drive import MemorySequence
from recorded_drive import record

from bevcli.errors import InputError
from bevcli.viewer.recording_file import whole_recording
from bevcli.viewer.recording_reader import RecordingReader


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "recording.rrd"
    record(path, MemorySequence(3))
    return path


def test_a_whole_recording_is_taken_as_it_is(recording):
    with whole_recording(recording) as whole:
        assert (whole.path, whole.mended) == (recording, False)


@pytest.mark.parametrize("share", [0.5, 0.75, 0.98])
def test_a_recording_cut_anywhere_opens_with_what_it_has(recording, tmp_path, share):
    content = recording.read_bytes()
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(content[: int(share * len(content))])
    with whole_recording(cut) as whole:
        assert whole.mended
        frames = [frame.index for frame in RecordingReader(whole.path).frames()]
        copy = whole.path
    assert frames == list(range(len(frames)))
    assert 1 <= len(frames) <= 3
    assert not copy.exists()
    assert len(cut.read_bytes()) == int(share * len(content))  # the user's file is left alone


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(b"no recording at all", "no recording"), (b"", "empty"), (b"RRF2\0\x29\0\0", "cut off before its first frame")],
)
def test_a_file_that_is_no_recording_gets_one_line(tmp_path, content, complaint):
    path = tmp_path / "x.rrd"
    path.write_bytes(content)
    with pytest.raises(InputError, match=complaint) as caught, whole_recording(path):
        pass
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder_are_said(tmp_path):
    with pytest.raises(InputError, match="missing"), whole_recording(tmp_path / "none.rrd"):
        pass
    with pytest.raises(InputError, match="folder"), whole_recording(tmp_path):
        pass
