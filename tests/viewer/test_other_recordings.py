"""Recordings that were cut, optimized, merged, or written by another program or an old version of rerun."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from memory_drive import MemoryDrive, make_rig
from recorded_drive import record
from rerun.chunk import LazyChunkStream, RrdReader

from bevcli.errors import InputError
from bevcli.recording import entities
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.viewer import recording_file
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader, read_recording, recorded_boxes, summarise
from bevcli.workshop.video import RecordedImages, draw_frame, tiles


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
