"""OutputFormat: a format that drives are written in, registered under `bevcli.drive_writers`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import cv2

from bevcli.errors import InputError, OutputError
from bevcli.registry import load_form
from bevcli.sequences.options import WriteOptions
from bevcli.writing import output_errors, remove_parts, write_whole

if TYPE_CHECKING:
    from bevcli.frame import CameraImage, Frame, Sequence

GROUP: Final = "bevcli.drive_writers"
FORMATS = {"image/jpeg": "jpeg", "image/png": "png"}
SUFFIXES = {"jpeg": ".jpg", "png": ".png"}


class DriveWriter(AbstractContextManager["DriveWriter"], Protocol):
    """Writes a drive frame by frame: `with writer: writer.write(frame)`. What it writes is valid after the block only.

    After an error in the block, nothing under the final name opens as a drive.
    """

    def write(self, frame: Frame) -> None:
        """Write a frame and its images. Raises InputError for one that the format cannot hold, and OutputError."""


@contextmanager
def whole_folder(folder: Path, parts: Iterable[str]) -> Iterator[None]:
    """Make a folder, in which the block writes files and folders of these names; after an error they are deleted.

    So is the folder itself if it was missing before. Other files in it are kept.
    Raises OutputError where the folder cannot be made.
    """
    is_new = not folder.exists()
    with output_errors(folder, "created"):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            remove_parts(folder, parts)
            if is_new:
                folder.rmdir()
        raise


class FolderWriter(ExitStack):
    """Base of a `DriveWriter` of a folder: a subclass has `write` and `_finish`. After an error, its parts are deleted.

    Files that a subclass enters into the stack are closed before `_finish`.

    Attributes:
        folder: that is written.
    """

    def __init__(self, folder: Path, parts: Collection[str], *, force: bool, can_replace: bool = True) -> None:
        """Make room in the folder.

        parts: names of the files and folders that are written, and that `force` removes; others are kept.
        can_replace: whether what is there may be replaced.
        Raises OutputError if the folder has files that are not to be replaced, or it cannot be written.
        """
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file (expected a folder to write)")
        if folder.is_dir() and any(folder.iterdir()):
            if not (force and can_replace):
                way = ", or pass `force=True` to replace it" if can_replace else ""
                raise OutputError(f"{folder}: exists already: choose another folder{way}")
            remove_parts(folder, parts)
        super().__init__()
        self.folder = folder
        self.enter_context(whole_folder(folder, parts))
        self.push(self._close)

    def _close(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is None:
            self._finish()
            try:
                self._read_back()
            except InputError as error:
                raise InputError(f"{self.folder}: is not written, because it could not be read: {error}") from None

    def _finish(self) -> None:
        """Write what needs all frames."""

    def _read_back(self) -> None:
        """Open what was written, so that nothing is left that a run would refuse. Raises InputError."""

    def _write_image(self, name: str, image: CameraImage) -> str:
        """Write the file of an image; returns its path relative to the folder, with suffix."""
        content, form = image_file(image)
        write_whole(self.folder / f"{name}{SUFFIXES[form]}", content, parents=True)
        return f"{name}{SUFFIXES[form]}"


def image_file(image: CameraImage) -> tuple[bytes, str]:
    """The file of an image as it was read, or else a PNG; and its format, "jpeg" or "png"."""
    form = FORMATS.get(image.media_type or "")
    if image.encoded is None or form is None:
        return cv2.imencode(".png", image.pixels_bgr)[1].tobytes(), "png"
    return image.encoded, form


@dataclass(frozen=True)
class OutputFormat:
    """A format that drives are written in.

    Attributes:
        name: with an article, for messages: "a nuScenes root".
        opener: makes the writer of a path for a sequence. Raises OutputError, and InputError for a drive that the
            format cannot hold.
        takes_boxes: the option `boxes` is for this format.
        keeps_maps: maps and lines of the ground truth are written; otherwise they are left out.
    """

    name: str
    opener: Callable[[Path, Sequence, WriteOptions], DriveWriter]
    takes_boxes: bool = False
    keeps_maps: bool = False

    def left_out(self, frame: Frame) -> set[str]:
        """What the format cannot hold of a frame, in words."""
        maps = {"maps": frame.ground_truth_map, "lines of the map": frame.ground_truth_results or None}
        return set() if self.keeps_maps else {name for name, value in maps.items() if value is not None}


def open_writer(path: Path, sequence: Sequence, options: WriteOptions) -> DriveWriter:
    """The writer of a path in the format `options.form`.

    Raises InputError for an unknown format, an option of another format or a drive that the format cannot hold, and
    OutputError where the path cannot be written.
    """
    chosen: OutputFormat = load_form(GROUP, options.form)
    if options.boxes is not None and not chosen.takes_boxes:
        raise InputError(f"`boxes`: {chosen.name} takes no boxes of a run: remove the option")
    return chosen.opener(path, sequence, options)
