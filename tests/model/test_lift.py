"""The lift of boxes in images: geometry that is known without weights, and shapes."""

import math

import numpy as np
import pytest
import torch

from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes
from bevcli.model.lift import NO_BOX, Lift, LiftConfig, hidden_feet

CLASSES = tuple(NUSCENES_CLASSES)
GROUND_Z, CAMERA_M, FOCAL, SIZE = -1.84, 1.5, 500.0, (704.0, 396.0)


def camera(yaw: float, pitch: float = 0.0) -> np.ndarray:
    """(4, 4) image_from_bev of a camera at the origin, CAMERA_M above the ground, that looks along x turned by yaw."""
    c, s = math.cos(yaw), math.sin(yaw)
    down = np.array([0, 0, -1.0])
    ahead, right = np.array([c, s, 0]), np.array([s, -c, 0])
    ahead, down = math.cos(pitch) * ahead + math.sin(pitch) * down, math.cos(pitch) * down - math.sin(pitch) * ahead
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]]) @ [right, down, ahead]
    matrix[:3, 3] = -matrix[:3, :3] @ [0, 0, GROUND_Z + CAMERA_M]
    return matrix


def upright(
    matrix: np.ndarray, distance: float, yaw: float, height: float, width: float, z: float = 0.0
) -> list[float]:
    """Box in the image of a flat upright object that stands `z` above the ground."""
    ahead, side = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    points = [[*(distance * ahead + w * width / 2 * side), GROUND_Z + z + h, 1] for w in (-1, 1) for h in (0, height)]
    projected = np.array(points) @ matrix.T
    pixels = projected[:, :2] / projected[:, 2:3]
    return [*pixels.min(0), *pixels.max(0)]


def found(boxes: list[list[float]], name: str, score: float = 0.6) -> ImageBoxes:
    """Boxes of one class in one image."""
    logits = torch.full((1, 1, len(boxes), len(IMAGE_CLASSES)), -6.0)
    logits[..., IMAGE_CLASSES.index(name)] = math.log(score / (1 - score))
    shape = logits.shape[:3]
    labels, features = logits.argmax(-1), torch.zeros(*shape, 128)
    return ImageBoxes(
        torch.tensor([[boxes]]).float(), torch.full(shape, score), labels, logits, features, torch.zeros(*shape, 3)
    )


def lifted(lift: Lift, boxes: ImageBoxes, *matrices: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    with torch.inference_mode():
        return lift(boxes, torch.tensor(np.stack(matrices)).float()[None], torch.tensor([[SIZE] * len(matrices)]))


@pytest.fixture(scope="module")
def lift() -> Lift:
    torch.manual_seed(0)
    return Lift(LiftConfig(), CLASSES).eval()


@pytest.mark.parametrize("yaw", [0.0, 2.0, -2.5])
def test_a_person_is_put_where_foot_and_height_say(lift: Lift, yaw: float) -> None:
    box = upright(camera(yaw), 14, yaw + 0.2, 1.75, 0.6)
    logits, codes, _ = lifted(lift, found([box], "person"), camera(yaw))
    assert CLASSES[logits[0, 0].argmax()] == "pedestrian"
    assert codes[0, 0, :2].numpy() == pytest.approx([14 * math.cos(yaw + 0.2), 14 * math.sin(yaw + 0.2)], abs=1.0)


def test_all_boxes_tell_how_the_vehicle_pitches(lift: Lift) -> None:
    ahead = [(9.0, -0.4), (13.0, 0.3), (18.0, 0.1), (25.0, -0.2)]
    slopes = {}
    for pitch_deg in (-1.0, 0.0, 1.0):
        seen = camera(0.0, math.radians(pitch_deg))
        boxes = found([upright(seen, d, yaw, 1.75, 0.6) for d, yaw in ahead], "person")
        slopes[pitch_deg] = math.degrees(lifted(lift, boxes, camera(0.0))[2][0, 0])  # it is believed to be level
    # A vehicle that looks down by a degree sees feet higher up: a ground that rises by a degree.
    assert slopes[1.0] - slopes[0.0] == pytest.approx(1.0, abs=0.4)
    assert slopes[-1.0] - slopes[0.0] == pytest.approx(-1.0, abs=0.4)


def test_no_box_has_no_score_and_no_slope(lift: Lift) -> None:
    boxes = found([upright(camera(0), 14, 0, 1.75, 0.6)], "person")
    none = ImageBoxes(boxes.boxes, 0 * boxes.scores, boxes.labels, boxes.logits, boxes.features, boxes.cells)
    logits, codes, slopes = lifted(lift, none, camera(0))
    assert (logits == NO_BOX).all()
    assert codes.isfinite().all()
    assert (slopes == 0).all()


def test_a_box_of_a_second_class_does_not_count(lift: Lift) -> None:
    boxes = found([upright(camera(0), 14, 0, 1.75, 0.6)] * 2, "person")
    boxes.labels[0, 0, 1] = IMAGE_CLASSES.index("car")
    logits, _, _ = lifted(lift, boxes, camera(0))
    assert logits[0, 0].max() > 0
    assert logits[0, 1].max() == NO_BOX


def test_frames_of_a_batch_do_not_change_each_other(lift: Lift) -> None:
    first = found([upright(camera(0.5), d, 0.4, 1.75, 0.6) for d in (9, 20)], "person")
    second = found([upright(camera(0.5), d, 0.7, 1.6, 1.8) for d in (7, 12)], "car", 0.3)
    both = ImageBoxes(*(torch.cat([getattr(x, name) for x in (first, second)]) for name in vars(first)))
    matrices = torch.tensor(camera(0.5)).float()[None, None].repeat(2, 1, 1, 1)
    with torch.inference_mode():
        together = lift(both, matrices, torch.tensor([[SIZE]] * 2))
    for index, boxes in enumerate((first, second)):
        for a, b in zip(together, lifted(lift, boxes, camera(0.5)), strict=True):
            torch.testing.assert_close(a[index], b[0])


def test_a_nearer_box_hides_a_foot() -> None:
    boxes = torch.tensor([[[[10.0, 10, 30, 50], [20.0, 20, 60, 80]]]])
    hidden = hidden_feet(boxes, torch.ones(1, 1, 2))[0, 0]
    assert hidden[0] == pytest.approx(0.5 * (1 - 300 / (800 + 2400 - 300)))
    assert hidden[1] == 0


@pytest.mark.slow
def test_the_lift_is_exported(lift: Lift) -> None:
    boxes = found([upright(camera(0), 14, 0, 1.75, 0.6)] * 3, "person")

    class Exported(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.lift = lift

        def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
            *parts, matrices, sizes = inputs
            return tuple(self.lift(ImageBoxes(*parts), matrices, sizes))

    inputs = (*vars(boxes).values(), torch.tensor(camera(0)).float()[None, None], torch.tensor([[SIZE]]))
    program = torch.export.export(Exported(), inputs)
    for a, b in zip(program.module()(*inputs), Exported()(*inputs), strict=True):
        torch.testing.assert_close(a, b)
