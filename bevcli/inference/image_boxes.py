"""Boxes in the images of the cameras, from those in the network's input."""

import warnings

import numpy as np

from bevcli.geometry.boxes import Boxes2D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.model.config import ImageConfig
from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes
from bevcli.model.step import PreparedFrame

LEAST_SCORE = 0.05  # what is scored below is nothing
POINTS_OF_SIDE = 9  # of a box that is bent by a lens; the rectangle around them is the box


def camera_boxes(found: ImageBoxes, prepared: PreparedFrame, image: ImageConfig) -> dict[str, Boxes2D]:
    """Camera -> the boxes in its image as it was read, for the cameras that have an image.

    Cropping and resizing are undone. Where the image was undistorted for the network, the outline of a box is led
    through the lens, and the box becomes the rectangle around it. A box that is then outside of the image is left out.

    found: of a batch of one, on the CPU. prepared: the frame. image: of the model.
    """
    boxes = {}
    for index, (name, scale) in enumerate(zip(prepared.assignment.cameras, prepared.scales, strict=True)):
        if not prepared.has_image[0, index]:
            continue
        resized = found.boxes[0, index].double().numpy() + np.tile(image.crop_box[:2], 2) + 0.5
        corners, scores = in_image(resized / scale - 0.5, prepared.frame.rig[name]), found.scores[0, index].numpy()
        chosen = (scores >= LEAST_SCORE) & (corners[:, 2:] > corners[:, :2]).all(1)  # False for NaN
        classes = np.array(IMAGE_CLASSES)[found.labels[0, index].numpy()]
        boxes[name] = Boxes2D(corners[chosen], classes[chosen], scores[chosen].astype(np.float64))
    return boxes


def in_image(corners: Array, camera: Camera) -> Array:
    """Boxes (N, 4) of the undistorted image -> those in the camera's image, clipped to it; NaN behind the lens."""
    if camera.distortion is not None:
        share = np.linspace(0, 1, POINTS_OF_SIDE)
        ends = np.stack([np.zeros_like(share), np.ones_like(share)])
        x = np.concatenate([share, share, *ends])[:, None] * (corners[:, 2] - corners[:, 0]) + corners[:, 0]
        y = np.concatenate([*ends, share, share])[:, None] * (corners[:, 3] - corners[:, 1]) + corners[:, 1]
        outline = camera.distorted(np.stack([x, y], -1))  # (points, N, 2)
        with warnings.catch_warnings(action="ignore"):  # of boxes with NaN only
            corners = np.concatenate([np.nanmin(outline, 0), np.nanmax(outline, 0)], -1)
    return np.clip(corners, -0.5, np.tile((camera.width, camera.height), 2) - 0.5)
