"""`Prediction.plot`: the boxes lie where OpenCV projects them, and the map from above where the geometry says."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from memory_drive import MemoryDrive
from recorded_drive import GRID, boxes_ahead, predict

from bevcli.errors import InputError
from bevcli.frame import BevMap, CameraImage
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import apply, inverse

SEQUENCE = MemoryDrive(1)


@pytest.fixture(scope="module")
def prediction():
    """The known boxes, on grey images."""
    frame = SEQUENCE.load(0)
    grey = {name: CameraImage(0, np.full_like(image.pixels_bgr, 90)) for name, image in frame.images.items()}
    return replace(predict(frame), frame=replace(frame, images=grey))


def of_color(image, name):
    """(H, W) bool, the pixels in about the colour of a class: lines are smoothed."""
    color = NUSCENES_CLASSES[name].color
    return (np.abs(image.astype(int) - color[::-1]) < 80).all(-1)


def test_a_box_is_drawn_where_opencv_projects_it(prediction):
    image = prediction.plot("CAM_FRONT")
    camera, frame = SEQUENCE.rig["CAM_FRONT"], prediction.frame
    assert image.shape == (camera.height, camera.width, 3)
    camera_from_bev = inverse(camera.ego_from_camera) @ frame.rig.ego_from_bev
    corners = apply(camera_from_bev, boxes_ahead().corners()[0])
    pixels = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), camera.intrinsics, None)[0][:, 0]
    top = int(pixels[:, 1].min())
    rows, columns = np.nonzero(of_color(image, "car")[top:])  # its label is above
    assert (columns.min(), columns.max()) == pytest.approx((pixels[:, 0].min(), pixels[:, 0].max()), abs=2)
    assert top + rows.max() == pytest.approx(pixels[:, 1].max(), abs=2)
    assert (image[:20, -40:] == 90).all()  # the image itself, beside the boxes
    of_the_bus = np.s_[60:, :90]
    assert (image[of_the_bus] == 90).all()  # its score is 0.1
    assert (prediction.plot("CAM_FRONT", score=0.05)[of_the_bus] != 90).any()


def test_the_map_from_above_shows_boxes_and_areas(prediction):
    cells = np.zeros((20, 20), np.uint8)
    cells[0, 19] = 1  # ahead to the right
    area = BevMap(cells, GRID.x_range_m, GRID.y_range_m, {"drivable_road": 1})
    image = replace(prediction, segmentation=area).plot()
    assert image.shape == (640, 1920, 3)
    above = image[:, 1280:]
    half = 1.02 * GRID.y_range_m[1]  # of the view, metres
    car = boxes_ahead().centers[0]
    rows, columns = np.nonzero(of_color(above, "car"))
    assert np.median(columns) == pytest.approx(320 * (1 + car[0] / half), abs=12)
    assert rows.max() == pytest.approx(320 * (1 - (car[1] - 4.5 / 2) / half), abs=4)
    assert tuple(above[20, 620]) == (75, 64, 58)  # the road
    assert tuple(above[20, 20]) != (75, 64, 58)


def test_images_of_an_untrained_model_say_so(prediction):
    trained, random = prediction.plot("CAM_BACK"), replace(prediction, untrained=True).plot("CAM_BACK")
    assert np.array_equal(trained[:150], random[:150])
    warning = (random == (85, 70, 255)).all(-1)
    assert warning[150:].sum() > 20
    assert not (trained == (85, 70, 255)).all(-1).any()
    assert np.array_equal(prediction.plot(color_order="rgb"), prediction.plot()[..., ::-1])
    frame = prediction.frame
    kept = {name: image for name, image in frame.images.items() if name != "CAM_FRONT"}
    image = replace(prediction, frame=replace(frame, images=kept)).plot("CAM_FRONT")
    assert (image[-20:] == (25, 20, 18)).all()  # a missing image leaves its place dark
    assert not of_color(image, "car").any()


def test_mistakes_in_the_arguments_of_a_plot_are_named(prediction):
    with pytest.raises(InputError, match=r"`image=FRONT`: is not a camera of the rig \(it has CAM_FRONT, "):
        prediction.plot("FRONT")
    with pytest.raises(InputError, match='expected "bgr" or "rgb"'):
        prediction.plot(color_order="hsv")
    with pytest.raises(InputError, match="has no frame"):
        replace(prediction, frame=None).plot()
