"""Tracks in a recording: trails, labels, duplicates; and true positives and misses as `bevcli eval` counts them."""

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr
from memory_drive import MemoryDrive, make_rig
from recorded_drive import boxes_ahead, predict, recorded, with_truth

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.recording import entities
from bevcli.recording.entities import GROUND_TRUTH_COLOR, MISSED_COLOR, OTHER_COLOR
from bevcli.recording.log_boxes import (
    AHEAD_S,
    PAST_S,
    detectable,
    false_and_duplicate,
    ground_truth_colors,
    other_classes,
    true_positives,
)
from bevcli.recording.log_cameras import box_labels
from bevcli.viewer.recording_reader import RecordingReader, recorded_boxes
from bevcli.workshop.scores.detection import DetectionConfig, evaluate_detections

ONE = make_rig({"CAM_FRONT": 0.0})
CAR, PEDESTRIAN = entities.track("car", "7"), entities.track("pedestrian", "8")


def record_tracks(path, count: int, instances, scenes: str = "a" * 30):
    """A recording whose three boxes have these instances, by frame; returns its frames as read."""
    drive = MemoryDrive(count, ONE, scenes=scenes)
    boxes = [replace(boxes_ahead(), instances=np.array(instances(place))) for place in range(count)]
    frames = [drive.load(place) for place in range(count)]
    steps = [(frame, replace(predict(frame), boxes=each)) for frame, each in zip(frames, boxes, strict=True)]
    return recorded(path, drive, steps)


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
    (frame,) = recorded(tmp_path / "r.rrd", drive, [(drive.load(0), predict(drive.load(0)))])
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
    (read,) = recorded(tmp_path / "r.rrd", drive, [(frame, replace(predict(frame), boxes=twice))])
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


def boxes(places, classes, scores=None) -> Boxes3D:
    count = len(places)
    centers = np.column_stack([np.array(places, dtype=float), np.zeros(count)])
    score_array = None if scores is None else np.array(scores)
    return Boxes3D(centers, np.ones((count, 3)), np.zeros(count), np.zeros((count, 2)), np.array(classes), score_array)


def test_truth_outside_grid_or_without_points_is_undetectable():
    truth = replace(boxes([(0, 0), (1, 1), (80, 0)], ["car"] * 3), num_points=np.array([5, 0, 5]))
    assert detectable(truth, BevGrid(50, 50)).centers[:, 0].tolist() == [0]


def evaluated(predicted, truth):
    """As `true_positives`, from the matching of the evaluation at 2 m."""
    scores = evaluate_detections([predicted], [truth], DetectionConfig().unlimited())
    centers = {"truth": [], "predicted": []}
    row = DetectionConfig().distances_m.index(2.0)
    for part in scores.matches:
        centers["predicted"] += part.predictions.boxes.centers[part.matched[row] >= 0].tolist()
        centers["truth"] += part.ground_truth.boxes.centers[part.matched[row][part.matched[row] >= 0]].tolist()
    return (
        [center in centers["predicted"] for center in predicted.centers.tolist()],
        [center in centers["truth"] for center in truth.centers.tolist()],
    )


@pytest.mark.parametrize(
    ("truth", "predicted", "true", "found"),
    [
        (  # within two metres, and its class
            boxes([(0, 0), (10, 0), (20, 0)], ["car", "car", "bus"]),
            boxes([(0, 1.9), (10, 2.1), (20, 0)], ["car"] * 3, [0.9, 0.8, 0.7]),
            [True, False, False], [True, False, False],
        ),
        (boxes([(0, 0)], ["car"]), boxes([(0.1, 0), (0.5, 0)], ["car"] * 2, [0.3, 0.9]), [False, True], [True]),
        (  # at exactly two metres
            boxes([(0, 0), (10, 0)], ["car"] * 2),
            boxes([(0, 2.0), (10, np.nextafter(2.0, 0))], ["car"] * 2, [0.9, 0.8]),
            [False, True], [False, True],
        ),
        # Of equal scores the later one, as in the devkit.
        (boxes([(0, 0)], ["car"]), boxes([(0.1, 0), (0.5, 0)], ["car"] * 2, [0.7, 0.7]), [False, True], [True]),
    ],
)  # fmt: skip
def test_boxes_are_found_as_the_evaluation_does(truth, predicted, true, found):
    assert [part.tolist() for part in true_positives(predicted, truth)] == [true, found]
    assert evaluated(predicted, truth) == (true, found)


@pytest.mark.parametrize("seed", range(20))
def test_the_display_agrees_with_the_evaluation(seed):
    rng = np.random.default_rng(seed)
    names = np.array(["car", "bus", "pedestrian"])
    places = [rng.integers(0, 8, (count, 2)) + rng.uniform(0, 1e-6, (count, 2)) for count in (25, 60)]
    truth = boxes(places[0], rng.choice(names, 25))
    predicted = boxes(places[1], rng.choice(names, 60), rng.integers(1, 5, 60) / 5)
    true, found = true_positives(predicted, truth)
    assert true.any()
    assert not true.all()
    assert evaluated(predicted, truth) == (true.tolist(), found.tolist())


def test_ground_truth_of_other_classes_is_grey_and_never_missed():
    truth = boxes([(0, 0), (5, 0), (9, 0)], ["car", "Tricycle", "bus"])
    other = other_classes(truth, ("car", "bus"))
    assert other.tolist() == [False, True, False]
    assert not other_classes(truth, ("car", "bus", "Tricycle")).any()
    colors = ground_truth_colors(np.array([True, True, False]), other)
    assert colors.tolist() == [list(GROUND_TRUTH_COLOR), list(OTHER_COLOR), list(MISSED_COLOR)]
