"""Draws a prediction: the images of its frame with the boxes, and the map from above, as one image."""

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import ColorOrder, Frame, Prediction, check_color_order
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import inverse
from bevcli.recording import entities
from bevcli.recording.entities import EGO_COLOR, RING_COLOR, class_colors, map_colors
from bevcli.recording.log_boxes import MOVING_M_S, box_colors, image_box_colors
from bevcli.recording.log_cameras import PosedCamera, box_labels, labels_in_image, lines_in_images
from bevcli.recording.log_static import bev_image_points, range_lines
from bevcli.recording.meshes import default_vehicle
from bevcli.viewer import drawing
from bevcli.viewer.drawing import Canvas

TOP = (4, 5, 6, 7, 4)  # corners of a box, around its top


def plot(prediction: Prediction, image: str | None, score: float, color_order: ColorOrder) -> Canvas:
    """See `Prediction.plot`."""
    frame, boxes = prediction.frame, prediction.boxes.shown(score)
    check_color_order(color_order)
    if frame is None:
        raise InputError("the prediction has no frame, whose images `plot` draws: predict it anew, or set `frame`")
    if image is not None and image not in frame.rig.names:
        raise InputError(f"`image={image}`: is not a camera of the rig (it has {', '.join(frame.rig.names)})")
    colors = class_colors(prediction.object_classes.values())
    if image is None:
        drawn = _whole(prediction, frame, boxes, colors, score)
    else:
        camera = frame.rig[image]
        drawn = _camera_image(prediction, frame, boxes, colors, score, camera, camera.width, camera.height)
    return drawn if color_order == "bgr" else np.ascontiguousarray(drawn[..., ::-1])


def _whole(prediction: Prediction, frame: Frame, boxes: Boxes3D, colors: dict[str, Color], score: float) -> Canvas:
    canvas = drawing.new_sheet()
    sizes = {camera.name: (camera.width, camera.height) for camera in frame.rig.cameras}
    for tile in drawing.tiles_of(sizes, {camera.name: camera.yaw for camera in frame.rig.cameras}):
        camera = frame.rig[tile.camera]
        drawn = _camera_image(prediction, frame, boxes, colors, score, camera, tile.width, tile.height)
        canvas[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width] = drawn
    _draw_from_above(canvas[:, drawing.CAMERAS_WIDTH :], prediction, frame, boxes, colors)
    _draw_legend(canvas[drawing.CAMERAS_HEIGHT :, : drawing.CAMERAS_WIDTH], prediction, boxes, colors)
    return canvas


def _camera_image(
    prediction: Prediction,
    frame: Frame,
    boxes: Boxes3D,
    colors: dict[str, Color],
    score: float,
    camera: Camera,
    width: int,
    height: int,
) -> Canvas:
    """The image of a camera in some size with the boxes, (height, width, 3)."""
    scaled = camera.scaled(width / camera.width, height / camera.height)
    image = frame.images.get(camera.name)
    if image is None:
        canvas = np.full((height, width, 3), drawing.BACKGROUND, dtype=np.uint8)
        drawing.draw_title(canvas, camera.name, has_image=False)
        return canvas
    canvas = cv2.resize(image.pixels_bgr, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    world_from_camera = frame.world_from_ego_at[camera.name].matrix @ camera.ego_from_camera
    posed = PosedCamera(scaled, world_from_camera, inverse(world_from_camera))
    world_from_bev = prediction.world_from_ego.matrix @ prediction.ego_from_bev
    [lines] = lines_in_images(boxes.transformed(world_from_bev).corners(), [posed])
    own_colors, texts = box_colors(boxes, colors), box_labels(boxes)
    if prediction.image_boxes and camera.name in prediction.image_boxes:
        in_image = prediction.image_boxes[camera.name].scored(score)
        shades = image_box_colors(prediction, frame, {camera.name: in_image}, score, colors)[camera.name]
        for outline, color in zip(in_image.outlines(), shades, strict=True):
            drawing.draw_lines(canvas, [outline * (width / camera.width, height / camera.height)], _bgr(color))
    for box in np.unique(lines.owners):
        drawing.draw_lines(canvas, lines.segments[lines.owners == box], _bgr(own_colors[box]), 1 + width // 800)
    size = max(drawing.SMALL_TEXT, width * drawing.LABEL_SHARE)
    for (x, y), box in zip(*labels_in_image(lines, texts, width, height), strict=True):
        drawing.draw_text(canvas, texts[box], (int(x), max(int(y), 10)), _bgr(own_colors[box]), size, centered=True)
    drawing.draw_title(canvas, camera.name, has_image=True)
    if prediction.untrained:
        drawing.draw_text(canvas, drawing.UNTRAINED, (width // 2, height - 14), drawing.WARNING, 0.42, centered=True)
    return canvas


def _draw_from_above(
    canvas: Canvas, prediction: Prediction, frame: Frame, boxes: Boxes3D, colors: dict[str, Color]
) -> None:
    """The map, range rings, boxes with their velocities, and the vehicle, in the bev frame."""
    grid, rings = prediction.grid, range_lines(frame.rig, prediction.grid)
    to_canvas = drawing.from_above(drawing.BEV_MARGIN * max(np.abs([*grid.x_range_m, *grid.y_range_m])))

    if prediction.segmentation is not None:
        (left, right), (low, high) = prediction.segmentation.x_range_m, prediction.segmentation.y_range_m
        (x0, y0), (x1, y1) = to_canvas(np.array([[left, -high], [right, -low]])).round().astype(int)
        palette = map_colors(prediction.segmentation.classes)
        area = prediction.segmentation.painted(palette, entities.BACKGROUND)[..., ::-1]
        canvas[y0:y1, x0:x1] = cv2.resize(area, (x1 - x0, y1 - y0), interpolation=cv2.INTER_NEAREST)
    for ring in rings:
        drawing.draw_lines(canvas, [to_canvas(bev_image_points(frame.rig, ring))], _bgr(RING_COLOR))
    corners, own_colors = boxes.corners()[..., :2] * (1, -1), box_colors(boxes, colors)
    for index in reversed(range(len(boxes))):  # the best ones lie on top
        drawing.draw_lines(canvas, to_canvas(corners[index][[TOP]]), _bgr(own_colors[index]), 2)
        velocity = boxes.velocities[index] * (1, -1)
        if np.linalg.norm(velocity) > MOVING_M_S:  # not of NaN
            start = boxes.centers[index, :2] * (1, -1)
            tail, tip = to_canvas(np.stack([start, start + velocity]))
            drawing.draw_arrow(canvas, tail, tip, _bgr(own_colors[index]))
    for strip in default_vehicle().top_view:
        drawing.draw_lines(canvas, [to_canvas(bev_image_points(frame.rig, strip))], _bgr(EGO_COLOR), 2)


def _draw_legend(canvas: Canvas, prediction: Prediction, boxes: Boxes3D, colors: dict[str, Color]) -> None:
    scene = f"{prediction.stamp.scene}   " if prediction.stamp.scene else ""
    drawing.draw_text(canvas, f"{scene}frame {prediction.stamp.index}", (16, 24), drawing.TEXT, 0.6)
    drawing.draw_text(canvas, prediction.failure, (250, 24), drawing.WARNING, 0.45)
    counts = boxes.classes.tolist()
    entries = [(color, f"{name.replace('_', ' ')} {counts.count(name)}") for name, color in colors.items()]
    if prediction.segmentation is not None:
        maps = map_colors(prediction.segmentation.classes).items()
        entries += [(color, f"map: {name.replace('_', ' ')}") for name, color in maps]
    for index, (color, text) in enumerate(entries[:15]):
        drawing.draw_entry(canvas, (16 + 250 * (index % 5), 60 + 32 * (index // 5)), color, text)


def _bgr(color: Color | NDArray[np.uint8]) -> Color:
    red, green, blue = map(int, color)
    return blue, green, red
