"""corruptions.png: the middle frame of a scene, one row a corruption, one column a severity."""

from collections.abc import Sequence as Items
from pathlib import Path

import cv2
import numpy as np

from bevcli.frame import Frame, Sequence
from bevcli.geometry.transforms import inverse
from bevcli.recording.box_lines import lines_in_image
from bevcli.workshop.robustness.conditions import Condition, Corruption, Shown
from bevcli.workshop.robustness.options import StressOptions
from bevcli.workshop.synth.corruptions import Pixels
from bevcli.writing import write_whole

TILE_WIDTH = 400  # pixels
CAPTION = 24  # height of the text above a tile, pixels
GAP = 6
PAPER, INK, BOX = (28, 23, 20), (241, 236, 232), (60, 220, 255)  # BGR


def write_contact_sheet(path: Path, scene: Sequence, conditions: Items[Condition], options: StressOptions) -> None:
    """Write the sheet as a PNG. Raises OutputError."""
    index, rows = len(scene.stamps) // 2, dict[str, list[Pixels]]()
    for condition in conditions:
        corruption = condition.corruption
        if corruption.shown is Shown.NOTHING:
            continue
        if corruption.name not in rows:
            rows[corruption.name] = [_tile(scene.load(index), corruption, "clean")]
        (changed,) = condition.sequences(scene, options.seed, options.lost_images)
        rows[corruption.name].append(_tile(changed.load(index), corruption, condition.severity))
    if not rows:
        return
    _, encoded = cv2.imencode(".png", _sheet(list(rows.values())))
    write_whole(path, encoded.tobytes())


def _tile(frame: Frame, corruption: Corruption, severity: str) -> Pixels:
    """The part of a frame that shows a corruption, below its caption."""
    ahead = min(frame.rig.cameras, key=lambda camera: abs(camera.yaw)).name
    if corruption.shown is Shown.CAMERAS:
        tile = _mosaic(frame)
    else:
        tile = _camera_tile(frame, ahead, TILE_WIDTH, boxes=corruption.shown is Shown.BOXES)
    top, text = np.full((CAPTION, TILE_WIDTH, 3), PAPER, dtype=np.uint8), f"{corruption.name}: {severity}"
    cv2.putText(top, text, (2, CAPTION - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return np.concatenate([top, tile])


def _mosaic(frame: Frame) -> Pixels:
    """All cameras in rows of three, from left to right as they look."""
    cameras, cell = sorted(frame.rig.cameras, key=lambda camera: -camera.yaw), TILE_WIDTH // 3
    tiles = [_camera_tile(frame, camera.name, cell) for camera in cameras]
    height = max(tile.shape[0] for tile in tiles)
    rows = [_row(tiles[start : start + 3], cell, height, TILE_WIDTH) for start in range(0, len(tiles), 3)]
    return np.concatenate(rows)


def _camera_tile(frame: Frame, name: str, width: int, *, boxes: bool = False) -> Pixels:
    """A camera's image at a width, grey where it is missing."""
    camera = frame.rig[name]
    height = round(width * camera.height / camera.width)
    if name not in frame.images:
        return np.full((height, width, 3), 90, dtype=np.uint8)
    pixels = frame.images[name].pixels_bgr.copy()
    if boxes:
        _draw_boxes(pixels, frame, name)
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def _draw_boxes(pixels: Pixels, frame: Frame, name: str) -> None:
    """Draws the ground truth boxes where the stated calibration and poses see them."""
    if frame.ground_truth is None:
        return
    camera = frame.rig[name]
    camera_from_world = camera.camera_from_ego @ inverse(frame.world_from_ego_at[name].matrix)
    thickness = max(1, round(pixels.shape[1] / 500))
    for start, end in lines_in_image(frame.ground_truth, camera, camera_from_world).segments.astype(int):
        cv2.line(pixels, start.tolist(), end.tolist(), BOX, thickness, cv2.LINE_AA)


def _sheet(rows: list[list[Pixels]]) -> Pixels:
    cell = TILE_WIDTH + GAP
    width = max(map(len, rows)) * cell + GAP
    return np.concatenate([_row(row, cell, max(tile.shape[0] for tile in row) + GAP, width) for row in rows])


def _row(tiles: list[Pixels], cell_width: int, height: int, width: int) -> Pixels:
    """Tiles side by side, each in a cell, in a row of a height and a width."""
    return _padded(np.concatenate([_padded(tile, cell_width, height) for tile in tiles], axis=1), width, height)


def _padded(tile: Pixels, width: int, height: int) -> Pixels:
    canvas = np.full((height, width, 3), PAPER, dtype=np.uint8)
    canvas[: tile.shape[0], : tile.shape[1]] = tile
    return canvas
