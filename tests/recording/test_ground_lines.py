"""What a recording has on the ground: lines of the map, futures, planned paths, and BEV features as images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from memory_drive import MemoryDrive
from recorded_drive import NamedModel, bev_from_world, boxes_ahead, predict, recorded

from bevcli.config import load_config
from bevcli.errors import InputError
from bevcli.geometry.transforms import apply
from bevcli.recording import entities
from bevcli.recording.log_ground import BevImages, future_lines
from bevcli.viewer.recording_reader import RecordedFrame
from bevcli.workshop.formats.map_lines import MapLines, line_colors
from bevcli.workshop.vad.plan import HALF_VEHICLE_M, Plan
from bevcli.workshop.video import RecordedImages, draw_frame, tiles

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
