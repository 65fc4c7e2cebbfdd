"""Labels of KITTI: a tracking file of a drive (label_02/0000.txt), or a folder with an object file for each frame."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.parsing.files import MIB, read_text
from bevcli.sequences.options import LabelOptions
from bevcli.workshop.formats.labels.label_format import LabelFormat, LabelledFrame, Labels

LARGEST_BYTES = 256 * MIB
IGNORED = "DontCare"
# The words of a line after frame and track: type, truncated, occluded, alpha, the box in the image, then height, width,
# length, the middle of the bottom x, y, z in the frame of the camera, and rotation_y. Predictions add a score.
WORDS = (15, 16)
NAMES = ("height", "width", "length", "x", "y", "z", "rotation_y")


def read_kitti_labels(path: Path, rig: CameraRig, options: LabelOptions) -> Labels:
    """The boxes of a tracking file, or of a folder with files NNNNNN.txt. Raises InputError that names the line.

    They are in the frame of the camera `labels_camera`; by default of that which looks most directly ahead.
    """
    camera = _camera(rig, options.labels_camera)
    frames = _folder(path, camera) if path.is_dir() else _tracking_file(path, camera)
    note = f"the boxes are those that {camera.name} sees, in its frame (`labels_camera`); others have no labels"
    return Labels("ego", tuple(frames), lists_empty=path.is_dir(), notes=(note,))


def _camera(rig: CameraRig, name: str | None) -> Camera:
    if name is None:
        return min(rig.cameras, key=lambda camera: abs(camera.yaw))
    if name not in rig.names:
        raise InputError(f"`labels_camera={name}`: is not in the rig (expected one of {', '.join(rig.names)})")
    return rig[name]


def _folder(path: Path, camera: Camera) -> Iterator[LabelledFrame]:
    for file in sorted(path.glob("*.txt")):
        if not file.stem.isdecimal():
            raise InputError(f"{file}: expected the index of a frame as its name, such as 000042.txt")
        boxes = Boxes3D.concatenate(_box(where, words, "", camera) for where, words in _lines(file))
        yield LabelledFrame(int(file.stem), None, boxes)


def _tracking_file(path: Path, camera: Camera) -> Iterator[LabelledFrame]:
    frames: dict[int, list[Boxes3D]] = {}
    for where, words in _lines(path):
        if not words[0].isdecimal() or len(words) < 2:
            raise InputError(f'{where}: expected the index of a frame and a track, found "{" ".join(words):.40}"')
        box = _box(where, words[2:], words[1], camera)
        if len(box):
            frames.setdefault(int(words[0]), []).append(box)
    for index, boxes in frames.items():
        yield LabelledFrame(index, None, Boxes3D.concatenate(boxes))


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Place and words of each line that is not blank."""
    for number, line in enumerate(read_text(path, LARGEST_BYTES).splitlines(), 1):
        if words := line.split():
            yield f"{path}: line {number}", words


def _box(where: str, words: list[str], track: str, camera: Camera) -> Boxes3D:
    """The box of a line in the ego frame; none for an area without labels."""
    if words and words[0] == IGNORED:
        return Boxes3D.empty()
    try:
        height, width, length, x, y, z, rotation_y = (float(word) for word in words[8:15])
    except ValueError:
        raise InputError(
            f"{where}: expected {WORDS[0]} or {WORDS[1]} words from the type on, with {', '.join(NAMES)} as numbers"
        ) from None
    if len(words) not in WORDS or not np.isfinite([height, width, length, x, y, z, rotation_y]).all():
        raise InputError(f"{where}: expected {WORDS[0]} or {WORDS[1]} words, and finite numbers")
    rotation = camera.ego_from_camera[:3, :3]
    heading = rotation @ [np.cos(rotation_y), 0, -np.sin(rotation_y)]
    center = rotation @ [x, y, z] + camera.ego_from_camera[:3, 3] + [0, 0, height / 2]
    return Boxes3D(
        center[None], np.array([[length, width, height]]), np.array([np.arctan2(heading[1], heading[0])]),
        np.full((1, 2), np.nan), np.array([words[0]]), instances=np.array([track]),
    )  # fmt: skip


def _recognises(path: Path) -> bool:
    return path.suffix.lower() == ".txt" or (path.is_dir() and next(path.glob("*.txt"), None) is not None)


FORMAT = LabelFormat("KITTI labels (.txt, or a folder of these)", _recognises, read_kitti_labels)
