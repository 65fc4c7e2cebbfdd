"""LabelFormat: a format of labels, registered under `bevcli.label_formats`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeVar

import msgspec

from bevcli.errors import InputError
from bevcli.geometry.boxes import IMPOSSIBLE, Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.parsing.files import MIB, read_bytes
from bevcli.printing import counted
from bevcli.registry import entries, load
from bevcli.sequences.options import LabelOptions

GROUP = "bevcli.label_formats"
FIRST_BYTES = 4096
LARGEST_BYTES = 1024 * MIB
FrameOfReference = Literal["world", "ego", "bev"]
Moment = tuple[int | None, int | None]  # index and time of a frame, ns, as in LabelledFrame
_Struct = TypeVar("_Struct")


@dataclass(frozen=True)
class LabelledFrame:
    """The boxes of one frame.

    Attributes:
        index: of the frame; None if the file has times only.
        timestamp_ns: of the frame; None if the file has indices only.
        boxes: in the frame of reference of the file.
    """

    index: int | None
    timestamp_ns: int | None
    boxes: Boxes3D


@dataclass(frozen=True)
class Labels:
    """The contents of a file of labels.

    Attributes:
        frame_of_reference: of all boxes.
        frames: in the order of the file.
        lists_empty: frames without boxes are in the file, too. If not, a frame of the drive that the file does not
            have may be empty or not labelled.
        notes: what was assumed, for the user.
    """

    frame_of_reference: FrameOfReference
    frames: tuple[LabelledFrame, ...]
    lists_empty: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LabelFormat:
    """A format of labels.

    Attributes:
        name: with an article, for messages.
        recognises: whether a file has this format; looks at its name, or at a few bytes.
        read: reads a file of a drive with this rig. Raises InputError.
    """

    name: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, CameraRig, LabelOptions], Labels]


def starts_with(path: Path, ending: str, word: str) -> bool:
    """True for a file with an ending such as ".json" and a word in its first 4 KiB."""
    if path.suffix.lower() != ending or not path.is_file():
        return False
    with path.open("rb") as file:
        return word.encode() in file.read(FIRST_BYTES)


def decoded(path: Path, kind: type[_Struct], name: str) -> _Struct:
    """The contents of a JSON file as a struct. name: of the format, for the message. Raises InputError."""
    try:
        return msgspec.json.decode(read_bytes(path, LARGEST_BYTES), type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not {name}: {error}") from None


def read_labels(path: Path, rig: CameraRig, options: LabelOptions) -> Labels:
    """The labels of a file of any known format. rig: of the drive. Raises InputError."""
    known: list[LabelFormat] = [load(GROUP, name) for name in entries(GROUP)]
    found = next((one for one in known if one.recognises(path)), None)
    if found is None:
        raise InputError(f"{path}: is no file of labels (expected {' or '.join(one.name for one in known)})")
    labels = found.read(path, rig, options)
    frames = tuple(replace(each, boxes=each.boxes.possible()) for each in labels.frames)
    left_out = sum(len(each.boxes) for each in labels.frames) - sum(len(each.boxes) for each in frames)
    note = (f"{counted(left_out, 'boxes')} {IMPOSSIBLE}",) if left_out else ()
    return replace(labels, frames=frames, notes=(*labels.notes, *note))
