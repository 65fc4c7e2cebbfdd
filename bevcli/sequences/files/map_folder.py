"""BEV maps in ground_truth_map/ and segmentation/: one PNG per frame, and map.json ("bevcli-map/1")."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bevcli.errors import InputError
from bevcli.frame import MOST_MAP_CLASSES, BevMap
from bevcli.parsing.documents import read_json
from bevcli.parsing.files import read_bytes
from bevcli.parsing.images import decode_image, encode_image
from bevcli.writing import write_whole

FORMAT = "bevcli-map/1"
LEGEND = "map.json"
LARGEST_BYTES, LARGEST_CELLS = 64 << 20, 64 << 20  # of one map
LONGEST_NAME = 100  # characters of a class


@dataclass(frozen=True)
class MapFolder:
    """A folder of maps with one extent in the bev frame, metres. classes: class -> its bit, by rising bit."""

    path: Path
    x_range_m: tuple[float, float]
    y_range_m: tuple[float, float]
    classes: Mapping[str, int]

    def has(self, frame: int) -> bool:
        """True if the folder has a map of this frame."""
        return map_path(self.path, frame).is_file()

    def load(self, frame: int) -> BevMap:
        """The map of a frame. Raises InputError if it is missing, unreadable or has an unknown bit."""
        path = map_path(self.path, frame)
        encoded = read_bytes(path, LARGEST_BYTES, missing=f"the map of frame {frame} is missing")
        cells = decode_image(encoded, cv2.IMREAD_UNCHANGED, LARGEST_CELLS)
        if cells is None or cells.ndim != 2 or cells.dtype != np.uint8:
            found = "an unreadable image" if cells is None else f"{cells.dtype} of shape {cells.shape}"
            raise InputError(f"{path}: expected an 8-bit image with one channel, found {found}")
        unknown = int(np.bitwise_or.reduce(cells, axis=None)) & ~sum(self.classes.values())
        if unknown:
            raise InputError(f"{path}: bits {unknown:#x} belong to no class in {LEGEND} ({', '.join(self.classes)})")
        return BevMap(cells.astype(np.uint8), self.x_range_m, self.y_range_m, self.classes)


def open_maps(path: Path) -> MapFolder:
    """Open a folder of maps. Only map.json is read here. Raises InputError if it is missing or invalid."""
    legend_path = path / LEGEND
    missing = "the file is missing (expected the extent and classes of the maps in this folder)"
    legend = read_json(legend_path, missing=missing)
    form = legend.get("format") if isinstance(legend, dict) else type(legend).__name__
    if form != FORMAT:
        raise InputError(f'{legend_path}: "format" must be "{FORMAT}", found {form!r:.40}')
    ranges: dict[str, tuple[float, float]] = {}
    for key in ("x_range_m", "y_range_m"):
        value = legend.get(key)
        numbers = value if isinstance(value, list) and all(type(v) in (int, float) for v in value) else []
        if len(numbers) != 2 or not numbers[0] < numbers[1]:
            raise InputError(
                f'{legend_path}: "{key}" must be two numbers, smaller first, in metres; found {value!r:.60}'
            )
        ranges[key] = float(numbers[0]), float(numbers[1])
    value = legend.get("classes")
    bits = {str(1 << index): 1 << index for index in range(MOST_MAP_CLASSES)}
    names = value.values() if isinstance(value, dict) else ()
    texts = {text for text in names if isinstance(text, str) and 0 < len(text) <= LONGEST_NAME and text.isprintable()}
    if not isinstance(value, dict) or not value or not value.keys() <= bits.keys() or len(texts) != len(value):
        raise InputError(
            f'{legend_path}: "classes" must name bits, such as {{"1": "drivable_road", "2": "lane_boundary"}}: powers '
            f"of two up to {max(bits.values())}, each name once; found {value!r:.80}"
        )
    classes = {str(name): bits[bit] for bit, name in sorted(value.items(), key=lambda item: bits[item[0]])}
    return MapFolder(path, ranges["x_range_m"], ranges["y_range_m"], classes)


def write_map(folder: Path, frame: int, bev_map: BevMap) -> None:
    """Write a frame's map as NNNNNN.png. The folder and map.json are created if they are missing.

    Raises OutputError if the map cannot be written, and InputError if the folder's maps have another extent or
    other classes.
    """
    legend = {
        "format": FORMAT,
        "x_range_m": list(bev_map.x_range_m),
        "y_range_m": list(bev_map.y_range_m),
        "classes": {str(bit): name for name, bit in bev_map.classes.items()},
    }
    path = folder / LEGEND
    if not path.exists():
        write_whole(path, f"{json.dumps(legend, indent=1)}\n".encode(), parents=True, regular=True)
    elif (existing := read_json(path)) != legend:
        raise InputError(f"{path}: states {existing!r:.300}, but the new map has {legend}: write it to another folder")
    write_whole(map_path(folder, frame), encode_image(bev_map.cells, ".png"), regular=True)


def map_path(folder: Path, frame: int) -> Path:
    """The file of a frame's map in a folder of maps."""
    return folder / f"{frame:06d}.png"
