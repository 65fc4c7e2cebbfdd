"""Tracks, lines, futures, planned paths and BEV features in a recording; hits and misses as of `bevcli eval`."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import rerun as rr
from memory_drive import MemoryDrive, make_rig
from recorded_drive import NamedModel, bev_from_world, boxes_ahead, predict, recorded, with_truth

from bevcli.config import load_config
from bevcli.errors import InputError
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import apply
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
from bevcli.recording.log_ground import BevImages, future_lines
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader, recorded_boxes
from bevcli.workshop.formats.map_lines import MapLines, line_colors
from bevcli.workshop.scores.detection import DetectionConfig, evaluate_detections
from bevcli.workshop.vad.plan import HALF_VEHICLE_M, Plan
from bevcli.workshop.video import RecordedImages, draw_frame, tiles

ONE = make_rig({"CAM_FRONT": 0.0})
CAR, PEDESTRIAN = entities.track("car", "7"), entities.track("pedestrian", "8")


def record_tracks(path, count: int, instances, scenes: str = "a" * 30):
    """A recording whose three boxes have these instances, by frame; returns its frames as read."""
    drive = MemoryDrive(count, ONE, scenes=scenes)
    boxes = [replace(boxes_ahead(), instances=np.array(instances(place))) for place in range(count)]
    frames = [drive.load(place) for place in range(count)]
    steps = [(frame, replace(predict(frame), boxes=each)) for frame, each in zip(frames, boxes, strict=True)]
    return recorded(path, drive, steps)


def track_strips(frame, entity: str) -> list[np.ndarray]:
    return [np.array(strip) for strip in frame.values(entity, "LineStrips3D:strips")]


def test_a_track_has_its_past_and_the_next_second(tmp_path):
    frames = record_tracks(tmp_path / "r.rrd", 4, lambda place: ["7", "", "9"])
    for place, frame in enumerate(frames):
        ahead, _, *past = track_strips(frame, CAR)
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
    assert len(track_strips(frames[19], CAR)[2]) == PAST_S / step_s + 1
    assert len(track_strips(frames[20], CAR)) == 2  # a new scene
    assert len(track_strips(frames[24], CAR)[2]) == 5


def test_a_track_comes_with_its_style_in_each_scene(tmp_path):
    record_tracks(tmp_path / "r.rrd", 6, lambda place: ["7", "" if place == 2 else "8", ""], scenes="aaaabb")
    column = "LineStrips3D:colors"
    chunks = [chunk for chunk in RecordingReader(tmp_path / "r.rrd").chunks() if chunk.entity_path.endswith("_8")]
    assert sum(column in str(chunk.to_record_batch().schema) for chunk in chunks) == 3  # frames 0, 3 and 4


def test_a_track_without_a_box_is_cleared(tmp_path):
    frames = record_tracks(tmp_path / "r.rrd", 4, lambda place: ["7", "" if place in (1, 2) else "8", ""])
    assert [bool(track_strips(frame, PEDESTRIAN)) for frame in frames] == [True, False, False, True]
    assert len(track_strips(frames[3], PEDESTRIAN)[2]) == 2  # it was lost for a second only: the trail goes on


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


TIMES = np.array([0.5, 1.0])
LINES = MapLines(
    (np.array([[-2.0, 4.0], [-2.0, 25.0]]), np.zeros((2, 2))), np.array(["divider", "boundary"]), np.array([0.9, 0.1])
)
PLAN = Plan(("left", "straight"), np.array([[[-1.0, 3], [-3, 6]], [[0, 4], [0, 8]]]), TIMES, "straight")


PLANNER = NamedModel(config=load_config("vad-tiny"))


def with_futures():
    boxes = boxes_ahead()
    places = boxes.centers[:, None, None, :2] + np.array([[[0.0, 2], [0, 4]], [[1, 2], [2, 4]]])
    seconds = np.broadcast_to(TIMES[:, None], (*places.shape[:3], 1))
    scores = np.tile([0.8, 0.4], (len(boxes), 1))
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1), future_scores=scores)


@pytest.fixture(scope="module")
def drive() -> MemoryDrive:
    return MemoryDrive(2)


@pytest.fixture(scope="module")
def frames(drive: MemoryDrive, tmp_path_factory: pytest.TempPathFactory) -> list[RecordedFrame]:
    """Two frames; the second has no image, and so no results."""
    steps = []
    for place, results in enumerate([(LINES, PLAN), ()]):
        frame = drive.load(place)
        boxes = with_futures() if results else boxes_ahead()[:0]
        steps.append((frame, replace(predict(frame), boxes=boxes, results=results)))
    return recorded(tmp_path_factory.mktemp("lines") / "r.rrd", drive, steps, PLANNER)


def strips(frame: RecordedFrame, entity: str, dimensions: int = 3) -> list[np.ndarray]:
    return [np.array(strip) for strip in frame.values(entity, f"LineStrips{dimensions}D:strips")]


def test_lines_from_above_are_in_the_bev_frame(frames: list[RecordedFrame]) -> None:
    (line,) = strips(frames[0], f"{entities.BEV}/map_lines", 2)  # the other has a lower score
    np.testing.assert_allclose(line * (1, -1), LINES.points[0], atol=1e-3)


def test_the_legend_names_lines_paths_and_futures(frames: list[RecordedFrame]) -> None:
    expected = ["line: divider", "line: ped crossing", "line: boundary", "planned path", "futures: colour of the box"]
    assert frames[1].values(entities.RUN, "line_names") == expected
    assert frames[1].values(f"{entities.LEGEND}/texts", "Points2D:labels")[-5:] == expected


def test_lines_in_the_scene_lie_on_the_ground(frames: list[RecordedFrame], drive: MemoryDrive) -> None:
    (line,) = strips(frames[0], f"{entities.WORLD}/map_lines")
    origin = frames[0].array(entities.WORLD, "origin", 3)[0]
    in_bev = apply(bev_from_world(drive.load(0)), line + origin)
    np.testing.assert_allclose(in_bev[:, :2], LINES.points[0], atol=1e-3)
    np.testing.assert_allclose(in_bev[:, 2], -drive.rig.ego_from_bev[2, 3], atol=0.05)


def test_a_line_in_the_image_is_where_opencv_projects_it(frames: list[RecordedFrame], drive: MemoryDrive) -> None:
    camera, height = drive.rig["CAM_FRONT"], drive.rig.ego_from_bev[2, 3]
    far = np.array([[-2.0, 25.0, -height]])
    in_camera = apply(np.linalg.inv(camera.ego_from_camera) @ drive.rig.ego_from_bev, far)
    expected, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), camera.intrinsics, None)
    segments = strips(frames[0], entities.overlay("CAM_FRONT", "map_lines"), 2)
    nearest = min(np.abs(segment - expected[0, 0]).max(1).min() for segment in segments)
    assert nearest < 1.5  # the camera took its image a few milliseconds later


def test_the_commanded_path_is_a_ribbon(frames: list[RecordedFrame]) -> None:
    found = strips(frames[0], f"{entities.BEV}/plan", 2)
    left, (one, other, *rungs), straight = found[0], found[1:-1], found[-1]
    np.testing.assert_allclose(left * (1, -1), [[0, 0], *PLAN.paths[0]], atol=1e-3)
    np.testing.assert_allclose(straight * (1, -1), [[0, 0], *PLAN.paths[1]], atol=1e-3)
    np.testing.assert_allclose(np.abs([one[:, 0], other[:, 0]]), HALF_VEHICLE_M, atol=1e-3)
    assert all(np.linalg.norm(rung[1] - rung[0]) == pytest.approx(2 * HALF_VEHICLE_M, abs=1e-3) for rung in rungs)


def test_futures_fade_with_time_and_with_the_score_of_the_mode() -> None:
    lines = future_lines(with_futures()[:1], {"car": (1, 2, 3)})
    assert len(lines.strips) == 4  # two modes of two steps
    np.testing.assert_allclose(lines.strips[0][:, :2], [[0, 12], [0, 14]])
    first, later, unlikely, _ = (color[3] for color in lines.colors)
    assert first > later
    assert unlikely == pytest.approx(first / 2, abs=1)


def test_a_frame_without_results_shows_none(frames: list[RecordedFrame]) -> None:
    for kind in ("map_lines", "plan", entities.FUTURES):
        assert strips(frames[0], f"{entities.WORLD}/{kind}")
        assert not strips(frames[1], f"{entities.WORLD}/{kind}")
        assert not strips(frames[1], entities.overlay("CAM_FRONT", kind), 2)


def test_a_video_shows_the_lines_in_their_colours(frames: list[RecordedFrame]) -> None:
    divider = line_colors(["divider"])["divider"][::-1]
    counts = []
    for frame in frames:
        from_above = draw_frame(frame, tiles(frame), RecordedImages())[:, 1280:].astype(int)
        counts.append((np.abs(from_above - divider).max(-1) < 60).sum())
    assert counts[0] > 50
    assert counts[1] == 0


def features(seed: int, rows: int = 6, columns: int = 5, channels: int = 12) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, columns, channels)).astype(np.float32)


@pytest.mark.parametrize("kind", ["norm", "pca", "channel:3"])
def test_colours_are_fitted_on_two_frames_and_then_kept(kind):
    images = BevImages(kind)
    assert images.push(0, features(0)) == []  # the first frame's image is ready with the second
    ready = images.push(1, features(1))
    assert [stamp for stamp, _ in ready] == [0, 1]
    images.push(2, 100 * features(2))  # would change any range that is not fixed
    ((_, again),) = images.push(3, features(0))
    np.testing.assert_array_equal(again, ready[0][1])


def test_the_image_of_a_single_frame_is_ready_at_the_end():
    images = BevImages("pca")
    assert images.push("only", features(0)) == []
    ((stamp, image),) = images.finish()
    assert stamp == "only"
    assert image.shape == (6, 5, 3)
    assert images.finish() == []


def test_the_row_with_the_largest_y_is_on_top():
    cells = np.zeros((4, 3, 2), dtype=np.float32)
    cells[3, 0] = 9  # row 3: the largest y; column 0: the smallest x
    images = BevImages("norm")
    images.push(0, cells)
    ((_, image),) = images.finish()
    brightest = np.unravel_index(image.sum(-1).argmax(), (4, 3))
    assert brightest == (0, 0)


def test_principal_components_are_those_of_the_singular_values():
    images = BevImages("pca")
    cells = np.zeros((20, 20, 3), dtype=np.float32)
    cells[..., 1] = np.linspace(-9, 9, 20)[:, None]  # the largest spread
    cells[..., 0] = np.linspace(-3, 3, 20)[None]
    images.push(0, cells)
    ((_, image),) = images.finish()
    red, green = image[..., 0].astype(int), image[..., 1].astype(int)
    assert (np.diff(red[:, 7]) <= 0).all()  # red is the largest component, along y; the largest y is on top
    assert red[0, 7] - red[-1, 7] > 200
    assert (np.diff(green[7]) >= 0).all()


def test_a_missing_channel_is_an_input_error():
    images = BevImages("channel:12")
    images.push(0, features(0))
    with pytest.raises(InputError, match="channels 0 to 11"):
        images.push(1, features(1))
