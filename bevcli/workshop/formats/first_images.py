"""The first image of each camera of a drive, found by names alone: cameras and image sizes that no file states."""

import csv
import io
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from bevcli.errors import InputError
from bevcli.parsing.documents import CSV_BYTES, name_of
from bevcli.parsing.files import IMAGE_SUFFIXES, MIB, VIDEO_SUFFIXES, is_there, read_bytes, read_text
from bevcli.parsing.images import size_of_image
from bevcli.sequences.videos import size_of_video
from bevcli.workshop.formats.camera_names import folder_of_images, match_names

LARGEST_IMAGE = 256 * MIB
OTHERS = ("frame", "scene", "timestamp_ns")  # columns of frames.csv that are no cameras


def first_images(drive: Path) -> dict[str, Path]:
    """The first image file or the video of each camera, by the camera's name.

    They are those of frames.csv, `images/CAMERA/*.jpg`, `videos/CAMERA.mp4` or `CAMERA/*.jpg`, the first of these that
    is there; of a drive that is a video, it is the video.
    """
    if drive.suffix.lower() in VIDEO_SUFFIXES and drive.is_file():
        return {drive.stem: drive}
    if is_there(drive / "frames.csv"):
        return _listed(drive / "frames.csv")
    for folder in (folder for folder in (drive / "images", drive / "videos", drive) if folder.is_dir()):
        videos = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in VIDEO_SUFFIXES}
        folders = (path for path in sorted(folder.iterdir()) if path.is_dir())
        images = {path.name: image for path in folders if (image := _first_in(path)) is not None}
        if videos or images:
            return videos | images
    return {}


def cameras_with_images(cameras: Iterable[str], drive: Path | None) -> tuple[list[str], str]:
    """The cameras that have images in a drive, and a note on the others; "" where none is left out.

    All of them where the drive has other images too: a name may be misspelt.
    """
    cameras, found = list(cameras), {} if drive is None else first_images(drive)
    used = match_names(cameras, found)
    others = [name for name in cameras if name not in used]
    if not others or not used or len(used) < len(found):
        return cameras, ""
    return list(used), f"without images, left out: {', '.join(others)}"


def _listed(table: Path) -> dict[str, Path]:
    """The first cell of each camera's column in frames.csv. Nothing of a broken table, which its own reader refuses."""
    first_files, cameras = dict[str, Path](), list[str]()
    with suppress(csv.Error):
        rows = csv.reader(io.StringIO(read_text(table, CSV_BYTES).removeprefix("\ufeff"), newline=""))
        names = [name_of(cell.strip()) for cell in next(rows, [])]
        cameras = [name for name in names if name not in OTHERS and not name.endswith(".timestamp_ns")]
        for row in rows:
            cells = dict(zip(names, row, strict=False))
            first = {name: name_of(cells[name].strip()) for name in cameras if cells.get(name)}
            first_files = {name: table.parent / cell.partition("#")[0] for name, cell in first.items()} | first_files
            if len(first_files) == len(cameras):
                break
    return {name: first_files[name] for name in cameras if name in first_files}


def _first_in(folder: Path) -> Path | None:
    names = (path for path in folder_of_images(folder).iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    return min(names, default=None)


def size_of_first(drive: Path | None, camera: str) -> tuple[int, int] | None:
    """(width, height) in pixels of a camera's first image; None where it has none that can be read."""
    images = {} if drive is None else first_images(drive)
    path = images.get(match_names([camera], images).get(camera, ""))
    if path is None:
        return None
    try:
        if path.suffix.lower() in VIDEO_SUFFIXES:
            return size_of_video(path)
        return size_of_image(read_bytes(path, LARGEST_IMAGE))
    except InputError:
        return None
