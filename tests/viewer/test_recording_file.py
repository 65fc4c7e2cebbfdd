"""Recordings that were cut, damaged, optimized, merged, or written by another program or an old version of rerun."""

import sys
import warnings
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from memory_drive import MemoryDrive, make_rig
from recorded_drive import NamedModel, predict, record, recorded
from rerun.chunk import LazyChunkStream, RrdReader

from bevcli.cli import viewing
from bevcli.errors import InputError
from bevcli.parsing.files import run_python
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.writer import Recording
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.viewer import ViewOptions, recording_file
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader, recorded_boxes, summarise
from bevcli.workshop.formats.convert import read_recording
from bevcli.workshop.video import RecordedImages, draw_frame, tiles


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
    """Ids in the file differ from run to run: what lies at a place may be an image, a name or compressed numbers."""
    content = bytearray(recording.read_bytes())
    start = place * len(content) // 12 if place < 6 else place * 1500
    content[start : start + 8] = bytes(byte ^ 0x55 for byte in content[start : start + 8])
    damaged = tmp_path / "damaged.rrd"
    damaged.write_bytes(content)
    message = f"{damaged}: "
    try:
        with open_recording(damaged) as file:
            reader = RecordingReader(file)
            if len(list(reader.frames())) + reader.left_out < 3:
                assert file != damaged  # a length is damaged: the rest counts as cut off, which `viz` says
                read_recording(file)  # says where no frame is left
    except InputError as error:
        message = str(error)
    assert message.startswith(f"{damaged}: ")


@pytest.mark.parametrize("entity", [entities.EGO, entities.BOXES])
def test_frames_whose_names_are_damaged_are_counted(recording, tmp_path, monkeypatch, capsys, entity):
    damaged, shown = tmp_path / "damaged.rrd", []
    monkeypatch.setattr(viewing, "_open_viewer", lambda file, options: shown.append(file))
    content = recording.read_bytes()
    damaged.write_bytes(content.replace(entity.encode(), entity.upper().encode()))
    viewing.show(damaged, ViewOptions(summary=True))
    assert "  frames    0 (3 without vehicle or boxes left out: is the file damaged?)\n" in capsys.readouterr().out
    viewing.show(damaged, ViewOptions())
    assert "damaged.rrd has no frames of a run" in capsys.readouterr().out
    assert shown == [damaged]
    for write in (
        lambda: viewing.show(damaged, ViewOptions(video=tmp_path / "v.mp4")),
        lambda: read_recording(damaged),
    ):
        with pytest.raises(InputError, match=rf"^{damaged}: the recording has no frames"):
            write()
    assert [*tmp_path.iterdir()] == [damaged]


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
    steps = ((frame, predict(frame)) for frame in map(drive.load, (0, 2, 6)))
    recorded(tmp_path / "r.rrd", drive, steps, options=RecordingOptions("minimal"))
    reader = RecordingReader(tmp_path / "r.rrd")
    for index in (0, 2, 6):
        reader.check_frame(index)
    for index, near in ((1, "0 and 2"), (5, "2 and 6"), (7, "6"), (-1, "0")):
        with pytest.raises(InputError, match=rf"`--frame {index}`.*3 frames from 0 to 6, .*\(nearest: {near}\)"):
            reader.check_frame(index)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "recording.rrd"
    record(path, MemoryDrive(3, make_rig({"CAM_FRONT": 0.0})))
    return path


def table(path, folder) -> str:
    write_csv(read_recording(path), folder / "boxes.csv")
    return (folder / "boxes.csv").read_text()


def written(path, chunks, recording_id="1"):
    LazyChunkStream.from_iter(chunks).write_rrd(path, application_id="bevcli", recording_id=recording_id)
    return path


def by_entity(chunk):
    return chunk.entity_path, chunk.is_static


@pytest.mark.parametrize("order", [lambda chunks: chunks[::-1], lambda chunks: sorted(chunks, key=by_entity)])
def test_chunks_in_any_order_are_the_same_frames(recording, tmp_path, order):
    other = written(tmp_path / "other.rrd", order(list(RrdReader(recording).stream())))
    assert table(other, tmp_path) == table(recording, tmp_path)
    assert "boxes     6\n          3 car\n          3 pedestrian\n" in summarise(other)


def test_a_cut_frame_never_has_boxes_or_poses_of_another(recording, tmp_path):
    content, ends = recording.read_bytes(), [recording_file.FILE_HEADER]
    while ends[-1] < len(content) and content[ends[-1]] in recording_file.MESSAGE_KINDS:
        _, length = recording_file.MESSAGE_HEADER.unpack_from(content, ends[-1])
        ends.append(ends[-1] + recording_file.MESSAGE_HEADER.size + length)
    whole = {frame.index: str(recorded_boxes(frame)) for frame in RecordingReader(recording).frames()}
    found = []
    for end in ends[len(ends) // 2 :: 10]:  # each after a whole message
        (tmp_path / "cut.rrd").write_bytes(content[:end])
        frames = list(RecordingReader(tmp_path / "cut.rrd").frames())
        found.append(len(frames))
        assert all(str(recorded_boxes(frame)) == whole[frame.index] for frame in frames)
    assert found == sorted(found)
    assert set(found) >= {1, 2}


POINT = pa.list_(pa.float32(), 2)


def column(values, kind=None):
    return pa.scalar(values, pa.list_(kind)) if kind is not None else pa.scalar(values)


@pytest.mark.parametrize(
    ("entity", "component", "values", "message"),
    [
        (entities.EGO, "timestamp_ns", column([5.5]), "expected 1 integers of 64 bits, found"),
        (entities.EGO, "timestamp_ns", None, "expected 1 integers of 64 bits, found"),
        (entities.EGO, "timestamp_ns", column([2**64 - 1], pa.uint64()), "expected 1 integers of 64 bits"),
        (entities.EGO, "pose", column([1.0, 2.0]), "expected 1 values of 16 numbers, found 2 of type double"),
        (entities.EGO, "pose", column([0.0] * 16), "expected a rotation and a place"),
        (entities.EGO, "pose", column([np.nan] * 16), "expected finite numbers, found NaN or infinity"),
        (entities.EGO, "scene", column([7]), "expected texts, found"),
        (entities.BOXES, "name", column(["car"]), r"expected 2 texts, found \['car'\]"),
        (entities.BOXES, "name", column([1, 2]), "expected 2 texts"),
        (entities.BOXES, "name", column(["car", None]), "expected 2 texts"),
        (entities.BOXES, "score", column(["a", "b"]), "expected 2 values of 1 numbers, found 2 of type string"),
        (entities.BOXES, "score", column([None, None], pa.float32()), "expected finite numbers"),
        (entities.BOXES, "score", None, "expected 2 values of 1 numbers, found 0"),
        (entities.BOXES, "velocity_x", column([np.inf, 0.0]), "expected finite numbers"),
        (entities.BOXES, "Boxes3D:centers", column([[np.nan, 0.0, 0.0]] * 2), "expected finite numbers"),
        (entities.BOXES, "Boxes3D:centers", column([[0.0] * 2] * 3, POINT), "expected 3 numbers in"),
        (entities.BOXES, "Boxes3D:half_sizes", column([[1.0] * 3]), "expected 2 values of 3 numbers"),
        (entities.BOXES, "Boxes3D:half_sizes", column([[1.0, -1.0, 1.0]] * 2), "expected sizes above 0"),
        (entities.BOXES, "Boxes3D:quaternions", None, "expected 2 values of 4 numbers, found 0"),
        (entities.RUN, "camera_names", None, "expected the names of cameras, found none"),
        (entities.RUN, "class_colors", column(["red"] * 10), "expected colours such as #ff9e2c"),
        (entities.camera("CAM_FRONT"), "Pinhole:resolution", column([[0.0, 0.0]]), "expected sizes above 0"),
        (entities.image("CAM_FRONT"), "EncodedImage:blob", column(["x"]), "expected bytes, found string"),
        (entities.BEV_BOXES, "LineStrips2D:strips", column([1, 2]), "expected lists of points"),
        (entities.BEV_BOXES, "LineStrips2D:colors", column(["red"]), "expected integers of 64 bits"),
        (entities.BEV_VELOCITY, "Arrows2D:vectors", column([[1.0, 1.0]] * 9), "expected 2 values of 2 numbers"),
    ],
)
def test_a_foreign_column_is_refused_in_one_line(recording, entity, component, values, message):
    frame = next(RecordingReader(recording).frames())
    row = {name: value for name, value in {**frame.rows[entity], component: values}.items() if value is not None}
    changed = replace(frame, rows={**frame.rows, entity: row})
    with pytest.raises(InputError, match=rf"recording\.rrd: frame 0: {entity}: {component}: {message}"):
        read_all(changed)


def read_all(frame):
    recorded_boxes(frame)
    draw_frame(frame, tiles(frame), RecordedImages())


@pytest.mark.parametrize(
    ("timeline", "time", "message"),
    [
        ("frame", {"timestamp": 1.7e9}, r'the timeline "frame" holds timestamp\[ns\]'),
        ("step", {"sequence": 0}, "the recording has no frames"),
    ],
)
def test_a_recording_without_frames_is_told(tmp_path, timeline, time, message):
    stream = rr.RecordingStream("other")
    stream.save(tmp_path / "r.rrd")
    stream.set_time(timeline, **time)
    stream.log(entities.EGO, rr.AnyValues(timestamp_ns=5))
    stream.disconnect()
    with pytest.raises(InputError, match=rf"r\.rrd: {message}"):
        read_recording(tmp_path / "r.rrd")


def test_several_recordings_in_one_file_are_told(recording, tmp_path):
    chunks = list(RrdReader(recording).stream())
    files = [written(tmp_path / f"{name}.rrd", chunks, name) for name in "ab"]
    merge = [str(recording_file.viewer_binary()), "rrd", "merge", *map(str, files), "-o", str(tmp_path / "both.rrd")]
    recording_file.run_program(merge, 60, recording_file.viewer_environment())
    with pytest.raises(InputError, match=r"both\.rrd: the file holds 2 recordings"):
        read_recording(tmp_path / "both.rrd")


@pytest.mark.parametrize("start", [b"RRF1\0\x05\0\0", b"RRF2\0\x16\1\0"])
def test_an_old_version_of_rerun_is_named_not_damage(recording, tmp_path, start):
    (tmp_path / "old.rrd").write_bytes(start + recording.read_bytes()[len(start) :])
    version = ".".join(map(str, start[4:7]))
    message = rf"old\.rrd: an old version of rerun wrote this recording, {version} \(expected 0\.23 or newer\)"
    with pytest.raises(InputError, match=message), open_recording(tmp_path / "old.rrd"):
        pass


def test_an_error_names_the_file_and_not_its_repaired_copy(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(recording_file, "_repair", lambda path, copy: copy.write_bytes(path.read_bytes()))
    monkeypatch.setattr(recording_file, "_check", lambda file, path: None)
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(recording.read_bytes()[:-5000])
    with pytest.raises(InputError, match=f"^{cut}: wrong$"):
        fail_in(cut)


def fail_in(path):
    with open_recording(path) as file:
        assert file != path
        raise InputError(f"{file}: wrong")


def test_a_recording_that_grows_while_it_is_read_is_no_error(recording, monkeypatch):
    reader = RecordingReader(recording)
    chunks = list(reader.chunks())
    passes = [chunks[: len(chunks) // 2], chunks]
    monkeypatch.setattr(reader, "chunks", lambda: passes.pop(0))
    assert [frame.index for frame in reader.frames()] in ([0], [0, 1])
