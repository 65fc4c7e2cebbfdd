"""The folders or files of cameras, whose names may differ from the calibration's in case, order and short forms."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from bevcli.parsing.files import IMAGE_SUFFIXES

SHORT = {
    "f": "front", "forward": "front", "b": "back", "rear": "back", "l": "left", "r": "right",
    "fl": "front left", "fr": "front right", "bl": "back left", "br": "back right", "rl": "back left",
    "rr": "back right",
}  # fmt: skip
WORD = re.compile(r"camera|cam|image|img|front|forward|back|rear|left|right|[a-z]+|\d+")
NUMBERED = re.compile(r"(image|img)_?\d+")  # such as image_2 of KITTI
ANY = {"camera", "cam", "image", "img", "raw"}  # words that tell no camera from another
DIRECTIONS = {"front", "back", "left", "right"}
INSIDE = ("data", "data_rect")  # folders in that of a camera
LOOKED_AT = 50  # entries of a folder


def words_of(name: str) -> frozenset[str]:
    """The words of a camera's name, without order, such as front and left for CAM_FRONT_LEFT, frontLeft and fl."""
    words = [word.lstrip("0") or "0" if word.isdigit() else word for word in WORD.findall(name.lower())]
    return frozenset(long_word for word in words for long_word in SHORT.get(word, word).split()) - ANY


def match_names(cameras: Iterable[str], names: Iterable[str]) -> dict[str, str]:
    """camera -> the one of `names` that is equal or, if that is unambiguous, the same but for case or by its words.

    A camera without one is left out. A name belongs to one camera at most.
    """
    cameras, names = list(cameras), list(names)
    matched: dict[str, str] = {}
    for key in (str, str.lower, words_of):
        unmatched = [name for name in cameras if name not in matched]
        free = [name for name in names if name not in matched.values()]
        for camera in unmatched:
            fitting = [name for name in free if key(name) and key(name) == key(camera)]
            if len(fitting) == 1 and sum(key(name) == key(camera) for name in unmatched) == 1:
                matched[camera] = fitting[0]
    return {camera: matched[camera] for camera in cameras if camera in matched}


def renamed(matched: Mapping[str, str]) -> str:
    """The names that differ, for a note; "" where none does."""
    pairs = [f"{name} is {camera}" for camera, name in matched.items() if name != camera]
    return "" if not pairs else f"; {', '.join(pairs)}"


def folder_of_images(path: Path) -> Path:
    """The folder of a camera's images: the camera's own, or one inside, as KITTI and EuRoC have it."""
    return next((path / name for name in INSIDE if (path / name).is_dir()), path)


def has_camera_folders(path: Path) -> bool:
    """True for a folder with a folder of images that is named like a camera."""
    return path.is_dir() and any(_is_camera_folder(folder) for folder in path.iterdir())


def _is_camera_folder(path: Path) -> bool:
    named = "cam" in path.name.lower() or words_of(path.name) & DIRECTIONS or NUMBERED.fullmatch(path.name.lower())
    if not named or not path.is_dir():
        return False
    files = (file for file, _ in zip(folder_of_images(path).iterdir(), range(LOOKED_AT), strict=False))
    return any(file.suffix.lower() in IMAGE_SUFFIXES for file in files)
