"""Draws a prediction: the images of its frame with the boxes, and the map from above, as one image.

A video draws its frames on the same sheet.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.errors import InputError
from bevcli.frame import ColorOrder, Frame, Prediction, check_color_order
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, inverse
from bevcli.recording import entities
from bevcli.recording.blueprint import rows_of_largest_images
from bevcli.recording.entities import EGO_COLOR, RING_COLOR, class_colors, map_colors
from bevcli.recording.log_boxes import MOVING_M_S, box_colors, image_box_colors
from bevcli.recording.log_cameras import PosedCamera, box_labels, labels_in_image, lines_in_images
from bevcli.recording.log_static import bev_image_points, range_lines
from bevcli.recording.meshes import default_vehicle
from bevcli.viewer.drawing import FONT, Canvas, draw_lines

ToCanvas = Callable[[Array], Array]  # points (K, 2) in the space of what is drawn -> (K, 2) pixels of a canvas
FAR = 1e5  # pixels; what lies farther outside of a canvas is drawn there
WIDTH, HEIGHT = 1920, 640
BEV_SIDE = 640
CAMERAS_WIDTH = WIDTH - BEV_SIDE
CAMERAS_HEIGHT = 500
SMALL_TEXT, LABEL_SHARE = 0.36, 1 / 1800  # size of a label: the smallest one, and by the width of the image
BEV_MARGIN = 1.02  # of the range rings and the border of the grid
BACKGROUND = (25, 20, 18)
TEXT, WARNING = (225, 220, 215), (85, 70, 255)
UNTRAINED = "UNTRAINED WEIGHTS: boxes are meaningless"
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
    canvas = new_sheet()
    sizes = {camera.name: (camera.width, camera.height) for camera in frame.rig.cameras}
    for tile in tiles_of(sizes, {camera.name: camera.yaw for camera in frame.rig.cameras}):
        camera = frame.rig[tile.camera]
        drawn = _camera_image(prediction, frame, boxes, colors, score, camera, tile.width, tile.height)
        canvas[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width] = drawn
    _draw_from_above(canvas[:, CAMERAS_WIDTH:], prediction, frame, boxes, colors)
    _draw_legend(canvas[CAMERAS_HEIGHT:, :CAMERAS_WIDTH], prediction, boxes, colors)
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
        canvas = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)
        draw_title(canvas, camera.name, has_image=False)
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
            draw_lines(canvas, [outline * (width / camera.width, height / camera.height)], _bgr(color))
    for box in np.unique(lines.owners):
        draw_lines(canvas, lines.segments[lines.owners == box], _bgr(own_colors[box]), 1 + width // 800)
    size = max(SMALL_TEXT, width * LABEL_SHARE)
    for (x, y), box in zip(*labels_in_image(lines, texts, width, height), strict=True):
        draw_text(canvas, texts[box], (int(x), max(int(y), 10)), _bgr(own_colors[box]), size, centered=True)
    draw_title(canvas, camera.name, has_image=True)
    if prediction.untrained:
        draw_text(canvas, UNTRAINED, (width // 2, height - 14), WARNING, 0.42, centered=True)
    return canvas


def _draw_from_above(
    canvas: Canvas, prediction: Prediction, frame: Frame, boxes: Boxes3D, colors: dict[str, Color]
) -> None:
    """The map, range rings, boxes with their velocities, and the vehicle, in the bev frame."""
    grid, rings = prediction.grid, range_lines(frame.rig, prediction.grid)
    to_canvas = from_above(BEV_MARGIN * max(np.abs([*grid.x_range_m, *grid.y_range_m])))

    if prediction.segmentation is not None:
        (left, right), (low, high) = prediction.segmentation.x_range_m, prediction.segmentation.y_range_m
        (x0, y0), (x1, y1) = to_canvas(np.array([[left, -high], [right, -low]])).round().astype(int)
        palette = map_colors(prediction.segmentation.classes)
        area = prediction.segmentation.painted(palette, entities.BACKGROUND)[..., ::-1]
        canvas[y0:y1, x0:x1] = cv2.resize(area, (x1 - x0, y1 - y0), interpolation=cv2.INTER_NEAREST)
    for ring in rings:
        draw_lines(canvas, [to_canvas(bev_image_points(frame.rig, ring))], _bgr(RING_COLOR))
    corners, own_colors = boxes.corners()[..., :2] * (1, -1), box_colors(boxes, colors)
    for index in reversed(range(len(boxes))):  # the best ones lie on top
        draw_lines(canvas, to_canvas(corners[index][[TOP]]), _bgr(own_colors[index]), 2)
        velocity = boxes.velocities[index] * (1, -1)
        if np.linalg.norm(velocity) > MOVING_M_S:  # not of NaN
            start = boxes.centers[index, :2] * (1, -1)
            tail, tip = to_canvas(np.stack([start, start + velocity]))
            draw_arrow(canvas, tail, tip, _bgr(own_colors[index]))
    for strip in default_vehicle().top_view:
        draw_lines(canvas, [to_canvas(bev_image_points(frame.rig, strip))], _bgr(EGO_COLOR), 2)


def _draw_legend(canvas: Canvas, prediction: Prediction, boxes: Boxes3D, colors: dict[str, Color]) -> None:
    scene = f"{prediction.stamp.scene}   " if prediction.stamp.scene else ""
    draw_text(canvas, f"{scene}frame {prediction.stamp.index}", (16, 24), TEXT, 0.6)
    draw_text(canvas, prediction.failure, (250, 24), WARNING, 0.45)
    counts = boxes.classes.tolist()
    entries = [(color, f"{name.replace('_', ' ')} {counts.count(name)}") for name, color in colors.items()]
    if prediction.segmentation is not None:
        maps = map_colors(prediction.segmentation.classes).items()
        entries += [(color, f"map: {name.replace('_', ' ')}") for name, color in maps]
    for index, (color, text) in enumerate(entries[:15]):
        draw_entry(canvas, (16 + 250 * (index % 5), 60 + 32 * (index // 5)), color, text)


def _bgr(color: Color | NDArray[np.uint8]) -> Color:
    red, green, blue = map(int, color)
    return blue, green, red


def new_sheet() -> Canvas:
    """An empty sheet: cameras to the left, a legend below them, the map from above to the right."""
    return np.full((HEIGHT, WIDTH, 3), BACKGROUND, dtype=np.uint8)


def from_above(reach_m: float) -> ToCanvas:
    """Points (K, 2) of the BEV view, metres to the right and down from the vehicle -> pixels. reach_m: to each edge."""
    return lambda points: np.clip((points / reach_m + 1) * BEV_SIDE / 2, -FAR, FAR)


def draw_arrow(canvas: Canvas, start: Array, end: Array, color: Color) -> None:
    """Draw an arrow between two points (2,) in pixels."""
    cv2.arrowedLine(canvas, start.astype(int).tolist(), end.astype(int).tolist(), color, 1, cv2.LINE_AA, 0, 0.25)


def draw_text(
    canvas: Canvas, text: str, position: tuple[int, int], color: Color, size: float = 0.45, *, centered: bool = False
) -> None:
    """Draw a line of text.

    position: x, y, pixels, of the middle of its left edge, or of its centre if `centered`. color: BGR.
    """
    (width, height), _ = cv2.getTextSize(text, FONT, size, 1)
    left = position[0] - width // 2 if centered else position[0]
    bottom = position[1] + height // 2
    if centered:
        cv2.rectangle(canvas, (left - 2, bottom - height - 3), (left + width + 2, bottom + 3), (24, 20, 18), -1)
    cv2.putText(canvas, text, (left, bottom), FONT, size, color, 1, cv2.LINE_AA)


def draw_title(canvas: Canvas, camera: str, *, has_image: bool) -> None:
    """Draw the name of a camera into the corner of its image."""
    cv2.rectangle(canvas, (0, 0), (10 * len(camera) + 12, 22), BACKGROUND, -1)
    text, color = (camera, TEXT) if has_image else (f"{camera}: no image", WARNING)
    draw_text(canvas, text, (8, 11), color, 0.42)


def draw_entry(canvas: Canvas, position: tuple[int, int], color: Color, text: str) -> None:
    """Draw an entry of a legend. position: x, y of its left edge. color: RGB."""
    x, y = position
    cv2.rectangle(canvas, (x, y - 7), (x + 14, y + 7), color[::-1], -1)
    draw_text(canvas, text, (x + 24, y), TEXT)


@dataclass(frozen=True)
class Tile:
    """The rectangle of a camera's image in the video frame, pixels."""

    camera: str
    left: int
    top: int
    width: int
    height: int


def tiles_of(sizes: Mapping[str, ArrayLike], yaws: Mapping[str, float]) -> tuple[Tile, ...]:
    """The rectangles of cameras. sizes: width and height of their images. yaws: radians, in the ego frame."""
    whole = {name: np.asarray(size, dtype=np.float64) for name, size in sizes.items()}
    aspect = min(width / height for width, height in whole.values())
    rows = rows_of_largest_images(yaws, aspect, CAMERAS_WIDTH, CAMERAS_HEIGHT)
    cell = CAMERAS_WIDTH // max(len(row) for row in rows), CAMERAS_HEIGHT // len(rows)
    layout = []
    for r, row in enumerate(rows):
        indent = (CAMERAS_WIDTH - len(row) * cell[0]) // 2
        for c, name in enumerate(row):
            width, height = whole[name]
            scale = min(cell[0] / width, cell[1] / height)
            w, h = max(1, round(width * scale)), max(1, round(height * scale))
            left, top = indent + c * cell[0] + (cell[0] - w) // 2, r * cell[1] + (cell[1] - h) // 2
            layout.append(Tile(name, left, top, w, h))
    return tuple(layout)
