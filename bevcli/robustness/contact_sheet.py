"""corruptions.png: what each corruption does to a frame, one row a corruption, one column a severity."""

from __future__ import annotations

from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bevcli.errors import OutputError
from bevcli.frame import Frame, Sequence
from bevcli.geometry.transforms import inverse
from bevcli.recording.box_lines import lines_in_image
from bevcli.robustness.conditions import Condition, Corruption
from bevcli.robustness.lost_images import LostImage
from bevcli.robustness.processing import Pixels

TILE_WIDTH = 400  # pixels
CAPTION = 24  # height of the text above a tile, pixels
GAP = 6
PAPER, INK, BOX = (28, 23, 20), (241, 236, 232), (60, 220, 255)  # BGR
BOXES = ("calibration_noise", "time_offset")  # the image stays; ground truth boxes show where the model looks
MOSAIC = ("camera_crash", "frame_lost")  # all cameras of the frame
NOT_SHOWN = ("ego_motion_lost", "frame_rate")  # they change no image


@dataclass(frozen=True)
class SheetOptions:
    """How a sheet is made.

    Attributes:
        seed: of the test.
        lost_images: what the model gets for a lost image.
        place: of the frame in its scene.
    """

    seed: int = 0
    lost_images: LostImage = "black"
    place: int = 0


def write_contact_sheet(path: Path, scene: Sequence, conditions: Items[Condition], options: SheetOptions) -> None:
    """Writes a PNG with the corruptions of the conditions, as the model gets them. Raises OutputError."""
    rows: dict[str, list[Pixels]] = {}
    for condition in conditions:
        corruption = condition.corruption
        if corruption is None or corruption.name in NOT_SHOWN:
            continue
        if corruption.name not in rows:
            clean = _tile(scene.load(options.place), corruption)
            rows[corruption.name] = [_captioned(clean, f"{corruption.name}: clean")]
        (changed,) = condition.sequences(scene, options.seed, options.lost_images)
        tile = _tile(changed.load(options.place), corruption)
        rows[corruption.name].append(_captioned(tile, f"{corruption.name}: {condition.severity}"))
    if rows:
        _write_png(path, _sheet(list(rows.values())))


def _tile(frame: Frame, corruption: Corruption) -> Pixels:
    if corruption.name in MOSAIC:
        return _mosaic(frame)
    ahead = min(frame.rig.cameras, key=lambda camera: abs(camera.yaw)).name
    return _camera_tile(frame, ahead, TILE_WIDTH, boxes=corruption.name in BOXES)


def _mosaic(frame: Frame) -> Pixels:
    """All cameras in rows of three, from left to right as they look."""
    names = [camera.name for camera in sorted(frame.rig.cameras, key=lambda camera: -camera.yaw)]
    tiles = [_camera_tile(frame, name, TILE_WIDTH // 3) for name in names]
    height = max(tile.shape[0] for tile in tiles)
    tiles = [_padded(tile, TILE_WIDTH // 3, height) for tile in tiles]
    tiles += [_padded(tiles[0][:0], TILE_WIDTH // 3, height)] * (-len(tiles) % 3)
    rows = [np.concatenate(tiles[start : start + 3], axis=1) for start in range(0, len(tiles), 3)]
    return _padded(np.concatenate(rows), TILE_WIDTH, height * len(rows))


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


def _captioned(tile: Pixels, text: str) -> Pixels:
    top = np.full((CAPTION, tile.shape[1], 3), PAPER, dtype=np.uint8)
    cv2.putText(top, text, (2, CAPTION - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return np.concatenate([top, tile])


def _sheet(rows: list[list[Pixels]]) -> Pixels:
    columns = max(map(len, rows))
    width = columns * (TILE_WIDTH + GAP) + GAP
    lines = []
    for row in rows:
        height = max(tile.shape[0] for tile in row)
        tiles = [_padded(tile, TILE_WIDTH + GAP, height + GAP) for tile in row]
        lines.append(_padded(np.concatenate(tiles, axis=1), width, height + GAP))
    return np.concatenate(lines)


def _padded(tile: Pixels, width: int, height: int) -> Pixels:
    canvas = np.full((height, width, 3), PAPER, dtype=np.uint8)
    canvas[: tile.shape[0], : tile.shape[1]] = tile
    return canvas


def _write_png(path: Path, pixels: Pixels) -> None:
    _, encoded = cv2.imencode(".png", pixels)
    try:
        path.write_bytes(encoded.tobytes())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
