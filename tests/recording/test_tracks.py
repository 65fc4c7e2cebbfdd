"""Tracks in a recording: trails, labels, duplicates."""

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr
from memory_drive import MemoryDrive, make_rig
from recorded_drive import NamedModel, boxes_ahead, predict, with_truth

from bevcli.recording import entities
from bevcli.recording.log_boxes import AHEAD_S, PAST_S, false_and_duplicate
from bevcli.recording.log_cameras import box_labels
from bevcli.recording.writer import Recording
from bevcli.viewer.recording_reader import RecordingReader, recorded_boxes

ONE = make_rig({"CAM_FRONT": 0.0})
CAR, PEDESTRIAN = entities.track("car", "7"), entities.track("pedestrian", "8")


def record_tracks(path, count: int, instances, scenes: str = "a" * 30):
    """A recording whose three boxes have these instances, by frame; returns its frames as read."""
    drive = MemoryDrive(count, ONE, scenes=scenes)
    with Recording(path, drive, NamedModel()) as recording:
        for place in range(count):
            frame = drive.load(place)
            boxes = replace(boxes_ahead(), instances=np.array(instances(place)))
            recording.log(frame, replace(predict(frame), boxes=boxes))
    return list(RecordingReader(path).frames())


def strips(frame, entity: str) -> list[np.ndarray]:
    return [np.array(strip) for strip in frame.values(entity, "LineStrips3D:strips")]


def test_a_track_has_its_past_and_the_next_second(tmp_path):
    frames = record_tracks(tmp_path / "r.rrd", 4, lambda place: ["7", "", "9"])
    for place, frame in enumerate(frames):
        ahead, _, *past = strips(frame, CAR)
        car = recorded_boxes(frame).boxes[0]
        origin = frame.array(entities.WORLD, "origin", 3)[0]
        np.testing.assert_allclose(ahead[1, :2] - ahead[0, :2], car.velocity * AHEAD_S, atol=1e-4)
        np.testing.assert_allclose(ahead[0, :2], (car.center - origin)[:2], atol=1e-4)
        assert [len(strip) for strip in past] == ([place + 1] if place else [])
    last = frames[-1]
    assert last.values(CAR, "track") == ["7"]
    assert recorded_boxes(last).boxes.instances.tolist() == ["7", ""]
    tracks = [entity for entity in last.rows if entity.startswith(entities.TRACKS)]
    assert tracks == [CAR]  # the pedestrian has no track, the bus is below the score
    assert len(last.values(entities.BEV_TRACKS, "LineStrips2D:strips")) == 2


@pytest.mark.slow
def test_the_past_ends_after_some_seconds_and_with_the_scene(tmp_path):
    frames = record_tracks(tmp_path / "r.rrd", 25, lambda place: ["7", "8", ""], scenes="a" * 20 + "b" * 10)
    step_s = 0.5
    assert len(strips(frames[19], CAR)[2]) == PAST_S / step_s + 1
    assert len(strips(frames[20], CAR)) == 2  # a new scene
    assert len(strips(frames[24], CAR)[2]) == 5


def test_a_track_comes_with_its_style_in_each_scene(tmp_path):
    record_tracks(tmp_path / "r.rrd", 6, lambda place: ["7", "" if place == 2 else "8", ""], scenes="aaaabb")
    column = "LineStrips3D:colors"
    chunks = [chunk for chunk in RecordingReader(tmp_path / "r.rrd").chunks() if chunk.entity_path.endswith("_8")]
    assert sum(column in str(chunk.to_record_batch().schema) for chunk in chunks) == 3  # frames 0, 3 and 4


def test_a_track_without_a_box_is_cleared(tmp_path):
    frames = record_tracks(tmp_path / "r.rrd", 4, lambda place: ["7", "" if place in (1, 2) else "8", ""])
    assert [bool(strips(frame, PEDESTRIAN)) for frame in frames] == [True, False, False, True]
    assert len(strips(frames[3], PEDESTRIAN)[2]) == 2  # it was lost for a second only: the trail goes on


def test_a_recording_without_a_tracker_has_no_tracks(tmp_path):
    drive = MemoryDrive(1, ONE)
    with Recording(tmp_path / "r.rrd", drive, NamedModel()) as recording:
        recording.log(drive.load(0), predict(drive.load(0)))
    (frame,) = RecordingReader(tmp_path / "r.rrd").frames()
    assert entities.BEV_TRACKS not in frame.rows
    assert recorded_boxes(frame).boxes.instances is None


def test_the_label_names_the_track():
    boxes = replace(boxes_ahead(), instances=np.array(["12", "", "3"]))
    assert box_labels(boxes) == ["car #12 0.90", "pedestrian 0.60", "bus #3 0.10"]
    assert box_labels(boxes_ahead()) == ["car 0.90", "pedestrian 0.60", "bus 0.10"]


def test_a_second_box_on_an_object_is_a_duplicate_not_false():
    boxes = boxes_ahead()[[0, 0, 0, 1]]
    moved = boxes.centers + [[0, 0, 0], [0.8, 0, 0], [9, 0, 0], [0, 0, 0]]
    boxes = replace(boxes, centers=moved, scores=np.array([0.9, 0.8, 0.7, 0.6]))
    truth = replace(boxes_ahead()[:1], scores=None)
    false, duplicate, _ = false_and_duplicate(boxes, truth)
    assert duplicate.tolist() == [False, True, False, False]
    assert false.tolist() == [False, False, True, True]  # a car far away, and a pedestrian


def test_the_marks_of_the_tracker_count_unless_the_box_is_true():
    boxes = replace(boxes_ahead(), duplicates=np.array([True, True, False]))
    truth = replace(boxes_ahead()[:1], scores=None)
    false, duplicate, _ = false_and_duplicate(boxes, truth)
    assert duplicate.tolist() == [False, True, False]
    assert false.tolist() == [False, False, True]
    assert [part.tolist() for part in false_and_duplicate(boxes, None)[:2]] == [[False] * 3, [True, True, False]]


def test_duplicates_are_marked_in_both_views(tmp_path):
    drive = MemoryDrive(1, ONE)
    frame = with_truth(drive.load(0))
    twice = boxes_ahead()[[0, 0, 1]]
    with Recording(tmp_path / "r.rrd", drive, NamedModel()) as recording:
        recording.log(frame, replace(predict(frame), boxes=twice))
    (read,) = RecordingReader(tmp_path / "r.rrd").frames()
    for entity, kind in ((entities.DUPLICATES, "LineStrips3D"), (entities.BEV_DUPLICATES, "LineStrips2D")):
        assert len(read.values(entity, f"{kind}:strips")) == 1
    assert len(read.values(entities.FALSE_BOXES, "LineStrips3D:strips")) == 2  # the pedestrian


def test_a_track_of_a_class_of_any_name_is_one_entity(tmp_path, capfd):
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "r.rrd")
    stream.log(entities.track("PKW / Lorry", "3"), rr.Points3D([[0, 0, 0]]), static=True)
    stream.disconnect()
    (chunk,) = (each for each in RecordingReader(tmp_path / "r.rrd").chunks() if "PKW" in each.entity_path)
    assert chunk.entity_path.strip("/") == entities.track("PKW / Lorry", "3")
    assert chunk.entity_path.replace("\\/", "").count("/") == 3  # /world/tracks/ and one name
    assert capfd.readouterr().err == ""  # rerun warns of names that it changes
