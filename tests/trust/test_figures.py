"""Figures of hand-made boxes: a box that moves as its velocity says persists, one that jumps does not."""

from dataclasses import replace

import numpy as np
import pytest

from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.workshop.trust.figures import figures_of

FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # of a camera 1.5 m above the ground
INTRINSICS = np.array([[250.0, 0, 250], [0, 250, 140], [0, 0, 1]])
RIG = CameraRig((Camera("CAM_FRONT", 500, 280, INTRINSICS, FORWARD),), Pose.identity().matrix)


def cars(*rows: tuple[float, float, float, float], score: float = 0.8) -> Boxes3D:
    """Cars at x, y in metres with a velocity in x, y."""
    n = len(rows)
    table = np.array(rows, dtype=float).reshape(n, 4)
    return Boxes3D(
        np.c_[table[:, :2], np.full(n, 0.8)],
        np.tile([4.5, 1.9, 1.6], (n, 1)),
        np.zeros(n),
        table[:, 2:],
        np.array(["car"] * n),
        np.full(n, score),
    )


def frame(index: int, boxes: Boxes3D, x: float = 0.0, scene: str = "") -> FrameBoxes:
    """A frame every 0.5 s. x: the vehicle's place."""
    return FrameBoxes(
        FrameStamp(index, scene, index * 500_000_000),
        Pose(np.array([x, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])),
        boxes,
    )


def persistence(*frames: FrameBoxes) -> float:
    return figures_of(frames, RIG, 51.2).persistence


def test_a_box_that_moves_as_its_velocity_says_persists() -> None:
    assert persistence(frame(0, cars((10, 3, 4, 0))), frame(1, cars((12, 3, 4, 0)))) == pytest.approx(1)


def test_a_standing_box_persists_where_the_vehicle_moves() -> None:
    assert persistence(frame(0, cars((10, 3, 0, 0))), frame(1, cars((5, 3, 0, 0)), x=5)) == pytest.approx(1)


def test_a_box_that_jumps_does_not_persist() -> None:
    assert persistence(frame(0, cars((10, 3, 4, 0))), frame(1, cars((15, 3, 4, 0)))) == 0


def test_a_box_half_a_metre_off_persists_in_part() -> None:
    assert persistence(frame(0, cars((10, 3, 0, 0))), frame(1, cars((10.5, 3, 0, 0)))) == pytest.approx(np.exp(-0.5))


def test_a_drive_without_boxes_has_a_persistence_of_0() -> None:
    assert persistence(frame(0, cars()), frame(1, cars())) == 0


def test_another_scene_is_no_next_frame() -> None:
    assert np.isnan(persistence(frame(0, cars((10, 3, 0, 0))), frame(1, cars((30, 3, 0, 0)), scene="b")))


def test_confidence_is_the_mean_of_the_15_best_scores() -> None:
    boxes = cars(*[(10, k, 0, 0) for k in range(20)], score=0.6)
    assert figures_of([frame(0, boxes)], RIG, 51.2).confidence == pytest.approx(0.6)
    assert figures_of([frame(0, boxes[:5])], RIG, 51.2).confidence == pytest.approx(0.2)
    assert figures_of([frame(0, boxes)], RIG, 5.0).confidence == 0


def test_a_box_that_grows_by_a_tenth_changes_its_size_by_a_tenth() -> None:
    box = cars((10, 3, 0, 0))
    larger = replace(box, sizes_lwh=1.1 * box.sizes_lwh)
    assert figures_of([frame(0, box), frame(1, larger)], RIG, 51.2).size_change == pytest.approx(np.log(1.1))


def test_certainty_does_not_depend_on_the_number_of_objects() -> None:
    assert figures_of([frame(0, cars((10, 3, 0, 0)))], RIG, 51.2).certainty == pytest.approx(0.8)
    assert figures_of([frame(0, cars(*[(10, k, 0, 0) for k in range(9)]))], RIG, 51.2).certainty == pytest.approx(0.8)


def test_rare_classes_count_less_in_class_certainty() -> None:
    many, one = cars(*[(10, k, 0, 0) for k in range(9)]), cars((5, 0, 0, 0), score=0.3)
    boxes = Boxes3D.concatenate([many, replace(one, classes=np.array(["bus"]))])
    weights = np.array([7.2 / 7.4, 0.3 / 0.5])
    expected = weights @ [0.8, 0.3] / weights.sum()
    assert figures_of([frame(0, boxes)], RIG, 51.2).class_certainty == pytest.approx(expected)


def test_at_half_the_rate_a_box_may_be_twice_as_far_off() -> None:
    later = replace(frame(1, cars((10.4, 3, 0, 0))), stamp=FrameStamp(1, "", 1_000_000_000))
    assert persistence(frame(0, cars((10, 3, 0, 0))), later) == pytest.approx(np.exp(-0.2))


def test_a_box_behind_the_only_camera_is_unseen() -> None:
    assert figures_of([frame(0, cars((10, 0, 0, 0), (-10, 0, 0, 0)))], RIG, 51.2).unseen == pytest.approx(0.5)
