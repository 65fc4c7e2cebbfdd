"""A recording that was cut off is repaired; a file that is not a recording is an error of one line."""

import sys
import warnings

import pytest
from memory_drive import MemoryDrive
from recorded_drive import NamedModel, predict, record
from rerun.chunk import RrdReader

from bevcli.errors import InputError
from bevcli.parsing.files import run_python
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.writer import Recording
from bevcli.viewer import recording_file
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "recording.rrd"
    record(path, MemoryDrive(3))
    return path


@pytest.mark.slow
def test_a_complete_recording_is_read_from_its_own_file(recording, monkeypatch):
    monkeypatch.setattr(recording_file, "run_python", run_python)  # a process as the user's
    with open_recording(recording) as file:
        assert file == recording


@pytest.mark.parametrize("share", [0.5, 0.75, 0.98])
def test_a_recording_cut_anywhere_keeps_its_first_frames(recording, tmp_path, share):
    content = recording.read_bytes()
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(content[: int(share * len(content))])
    with open_recording(cut) as file:
        assert file != cut
        frames = [frame.index for frame in RecordingReader(file).frames()]
        copy = file
    assert frames == list(range(len(frames)))
    assert 1 <= len(frames) <= 3
    assert not copy.exists()
    assert len(cut.read_bytes()) == int(share * len(content))  # the user's file is unchanged


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"some other file", "is not a recording"), (b"", "empty"), (b"RRF2\0\x29\0\0", "cut off before its first frame")],
)
def test_a_file_that_is_not_a_recording_is_an_error_of_one_line(tmp_path, content, message):
    path = tmp_path / "x.rrd"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught, open_recording(path):
        pass
    assert str(path) in str(caught.value)
    for other, said in ((tmp_path / "none.rrd", "no such recording"), (tmp_path, "folder")):
        with pytest.raises(InputError, match=said), open_recording(other):
            pass


@pytest.mark.parametrize("bev", ["pca", pytest.param("none", marks=pytest.mark.slow)])
def test_a_resumed_recording_shows_all_frames(tmp_path, bev):
    path, sequence, options = tmp_path / "recording.rrd", MemoryDrive(6), RecordingOptions(bev=bev)
    frames = [sequence.load(place) for place in range(6)]
    with Recording(path, sequence, NamedModel(), options) as first:
        for frame in frames[:3]:
            first.log(frame, predict(frame))
        state = first.state()
        first.log(frames[3], predict(frames[3]))  # lost: the state is older
    with Recording(path, sequence, NamedModel(), options, resume=state) as second:
        for frame in frames[3:]:
            second.log(frame, predict(frame))
    record(tmp_path / "whole.rrd", sequence, options, truth=False)
    with open_recording(path) as file:
        assert file == path
        assert_same_frames(file, list(RecordingReader(tmp_path / "whole.rrd").frames()))


def assert_same_frames(path, expected):
    found = list(RecordingReader(path).frames())
    assert [frame.index for frame in found] == [frame.index for frame in expected]
    for one, other in zip(found, expected, strict=True):
        assert one.rows.keys() == other.rows.keys()
        for entity in (entities.EGO, entities.BOXES, entities.TRAJECTORY):
            assert one.rows.get(entity) == other.rows.get(entity)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rerun warns about a file without an index
        assert len(RrdReader(path).recordings()) == 1


@pytest.mark.parametrize(
    "place", [pytest.param(place, marks=() if place in (2, 5, 6, 9) else pytest.mark.slow) for place in range(1, 12)]
)
def test_damaged_data_never_ends_the_process(recording, tmp_path, place):
    content = bytearray(recording.read_bytes())
    start = place * len(content) // 12 if place < 6 else place * 1500  # in an image, or in the descriptions of data
    content[start : start + 8] = bytes(byte ^ 0x55 for byte in content[start : start + 8])
    damaged = tmp_path / "damaged.rrd"
    damaged.write_bytes(content)
    message = f"{damaged}: "
    try:
        with open_recording(damaged) as file:
            assert list(RecordingReader(file).frames())
    except InputError as error:
        message = str(error)
    assert message.startswith(f"{damaged}: ")


@pytest.mark.parametrize("message", [0, 2, 5])
def test_a_message_of_unknown_kind_is_damage_not_the_end(recording, tmp_path, message):
    content = bytearray(recording.read_bytes())
    start = recording_file.FILE_HEADER
    for _ in range(message):
        start += recording_file.MESSAGE_HEADER.size + recording_file.MESSAGE_HEADER.unpack_from(content, start)[1]
    content[start] ^= 0x55
    (tmp_path / "damaged.rrd").write_bytes(content)
    with (
        pytest.raises(InputError, match="the recording cannot be read: it is damaged"),
        open_recording(tmp_path / "damaged.rrd"),
    ):
        pass


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit the memory of a process")
def test_the_first_process_to_read_a_recording_has_one_gigabyte(recording):
    greedy = recording_file.CHECK.replace("try:\n", "bytearray(1200 << 20)\ntry:\n")
    with recording_file._limited(recording) as (seconds, environment):
        done = run_python(greedy, [recording], 1 << 30, seconds, environment)
    assert done.returncode == 1
    assert b"MemoryError" in done.stderr


def test_a_frame_that_a_thinned_recording_lacks_is_an_error(tmp_path):
    """The viewer shows the frame before in silence."""
    drive = MemoryDrive(7)
    with Recording(tmp_path / "r.rrd", drive, NamedModel(), RecordingOptions("minimal")) as recording:
        for frame in map(drive.load, (0, 2, 6)):
            recording.log(frame, predict(frame))
    reader = RecordingReader(tmp_path / "r.rrd")
    for index in (0, 2, 6):
        reader.check_frame(index)
    for index, near in ((1, "0 and 2"), (5, "2 and 6"), (7, "6"), (-1, "0")):
        with pytest.raises(InputError, match=rf"`--frame {index}`.*3 frames from 0 to 6, .*\(nearest: {near}\)"):
            reader.check_frame(index)
