"""The native sequence folder as an input format."""

from collections.abc import Mapping
from pathlib import Path

from bevcli.options import option, options, parse_pairs
from bevcli.sequences.format import Format
from bevcli.sequences.options import RigOptions
from bevcli.sequences.output import OutputFormat

# Any of these makes a folder a native sequence, so that an incomplete one gets an error that names the missing file.
MARKERS = ("calibration.json", "frames.csv", "ego_motion.csv", "images", "videos")


def parse_class_map(texts: list[str]) -> dict[str, str]:
    """A class map from texts NAME=CLASS and names of TOML files. Raises ValueError, InputError for a file."""
    from bevcli.sequences.files.class_names import read_class_map

    files = [text for text in texts if text.endswith(".toml") and "=" not in text]
    pairs = parse_pairs([text for text in texts if text not in files], "NAME=CLASS or FILE.toml")
    merged: dict[str, str] = {}
    for file in files:
        merged |= read_class_map(Path(file))
    return merged | pairs


@options("Input")
class NativeOptions(RigOptions):
    """The options of a native folder."""

    class_map: Mapping[str, str] = option(
        default_factory=dict,
        help="Rename a class of the ground truth, such as Lorry=truck. Repeatable.",
        metavar="NAME=CLASS|FILE.toml",
        parse=parse_class_map,
        repeatable=True,
    )


def is_native_folder(path: Path) -> bool:
    """True if a folder contains any part of a native sequence."""
    return any((path / part).exists() for part in MARKERS)


FORMAT = Format(
    name="a sequence folder",
    expected="calibration.json, frames.csv, ego_motion.csv, images or videos",
    recognises=is_native_folder,
    opener="bevcli.sequences.native.folder:FolderSequence",
    options=NativeOptions,
    precedence=-10,
)

OUTPUT = OutputFormat("a sequence folder", "bevcli.sequences.native.writer:write_native")
