"""Boxes in the images of the cameras, back from the pixels of the network's input; and boxes where no camera looks."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive, make_camera, make_rig
from stepping import run

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig, Distortion, default_ego_from_bev
from bevcli.inference.preprocess import Preprocessor, camera_boxes
from bevcli.model.image_boxes import ImageBoxes
from bevcli.model.step import PreparedFrame
from bevcli.recording.log_cameras import box_labels

WHITE = (210, 100, 390, 200)  # columns and rows of a white rectangle, ends excluded, in images of 640 x 360
WIDE = Distortion("kannala_brandt", (0.05, -0.01, 0.002, 0.0))
BARREL = Distortion("brown_conrady", (-0.25, 0.06, 0.001, -0.001, 0.0))


def prepared(config: object, lens: Distortion | None = None) -> PreparedFrame:
    """A black image of CAM_FRONT with a white rectangle, and a black one of CAM_BACK, which is missing."""
    front = replace(make_camera("CAM_FRONT", 0, 640, 360), distortion=lens)
    rig = CameraRig((front, make_camera("CAM_BACK", 180, 640, 480)), default_ego_from_bev())
    frame = MemoryDrive(1, rig).load(0)
    pixels = np.zeros((360, 640, 3), np.uint8)
    pixels[WHITE[1] : WHITE[3], WHITE[0] : WHITE[2]] = 255
    front_only = {"CAM_FRONT": replace(frame.images["CAM_FRONT"], pixels_bgr=pixels)}
    return Preprocessor(config)(replace(frame, images=front_only))  # type: ignore[arg-type]


def image_boxes(boxes: list[list[float]], scores: list[float]) -> ImageBoxes:
    """Cars in the first of two images; the second has the same."""
    corners = torch.tensor([[boxes, boxes]])
    none = torch.zeros(1, 2, len(boxes), 0)
    labels = torch.full((1, 2, len(boxes)), 2)
    return ImageBoxes(corners, torch.tensor([[scores, scores]]), labels, none, none, none)


@pytest.mark.parametrize("lens", [None, BARREL, WIDE], ids=["pinhole", "brown_conrady", "fisheye"])
@pytest.mark.parametrize("crop", [None, (20, 10, 300, 160)])
def test_a_box_of_the_network_lies_on_the_object_in_the_image(mini_config, lens, crop):
    image = replace(mini_config.image, size=(320, 180), crop=crop, resize="area", half_pixel_shift=True)
    config = replace(mini_config, image=image)
    frame = prepared(config, lens)
    left, top, right, bottom = image.crop_box
    seen = frame.images[0, 0, 0].numpy()[: bottom - top, : right - left]
    rows, columns = np.nonzero(seen > (seen.max() + seen.min()) / 2)
    box = [columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5]
    found = camera_boxes(image_boxes([box, box], [0.8, 0.01]), frame, config.image)
    assert list(found) == ["CAM_FRONT"]  # the other has no image
    [car] = found["CAM_FRONT"]  # the other is too weak
    assert (car.class_name, car.score) == ("car", pytest.approx(0.8))
    expected = np.array(WHITE) - 0.5
    assert np.abs(car.corners - expected).max() < (1.1 if lens is None else 6)  # bent sides: the rectangle around them


def test_boxes_end_at_the_image_and_those_beside_it_are_left_out(mini_config):
    config = replace(mini_config, image=replace(mini_config.image, size=(320, 180)))
    around, beside = [-9.0, 20.0, 999.0, 999.0], [321.0, 20.0, 330.0, 40.0]
    found = camera_boxes(image_boxes([around, beside], [0.8, 0.7]), prepared(config), config.image)["CAM_FRONT"]
    np.testing.assert_allclose(found.corners, [[-0.5, 40.5, 639.5, 359.5]])
    assert len(found.scored(0.9)) == 0


FRONT = make_rig({"CAM_FRONT": 0})  # at x 0.9 m, z 1.6 m; it sees 5 / 8 of the depth to each side, 9 / 25 up and down


def at(*places_ego: tuple[float, float, float]) -> Boxes3D:
    """Boxes 4 m long, 2 m wide and 1.5 m high, in the ego frame."""
    count = len(places_ego)
    sizes, yaws, velocities = np.tile([4.0, 2.0, 1.5], (count, 1)), np.zeros(count), np.zeros((count, 2))
    return Boxes3D(np.array(places_ego), sizes, yaws, velocities, np.array(["car"] * count))


def test_a_frame_sees_boxes_by_their_vertical_axes():
    frame = MemoryDrive(2, rig=FRONT).load(1)
    boxes = at((10.9, 6.2, 1), (10.9, 6.3, 1), (-9.1, 0, 1), (1.9, 0, 0.75), (1.9, 0, 0.4), (10.9, -6.2, 1))
    in_world = boxes.transformed(frame.world_from_ego.matrix)
    # 1 m before the camera it sees from 1.24 m up: a box from 0 to 1.5 m reaches there, one up to 1.15 m does not.
    assert frame.sees(in_world).tolist() == [True, False, False, True, False, True]
    assert not replace(frame, images={}).sees(in_world).any()


def test_a_run_marks_what_no_camera_sees(mini_model):
    drive = MemoryDrive(2, rig=FRONT)
    (default, _), (every, _) = (run(mini_model, drive, track=False, unseen=unseen) for unseen in (False, True))
    for marked, plain in zip(default, every, strict=True):
        x, y, _ = (marked.boxes_ego.centers - (0.9, 0, 0)).T
        assert marked.boxes.unseen.any()
        assert (marked.boxes.unseen | ((x > 0) & (np.abs(y) < x * 5 / 8))).all()
        assert len(marked.boxes.shown(0)) == (~marked.boxes.unseen).sum()
        assert plain.boxes.unseen is None
        assert len(plain.boxes.shown(0)) == len(plain.boxes) == len(marked.boxes)
        assert np.array_equal(plain.boxes.scores, marked.boxes.scores)


def test_the_label_of_a_carried_box_says_so():
    boxes = replace(at((9, 0, 1), (9, 4, 1)), scores=np.array([0.5, 0.4]), instances=np.array(["3", ""]))
    assert box_labels(replace(boxes, unseen=np.array([True, False]))) == ["car #3 0.50 out of view", "car 0.40"]
