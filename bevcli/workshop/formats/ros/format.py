"""MCAP files and ROS 2 bags as an input format."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from bevcli.options import option, options, parse_pairs
from bevcli.parsing.files import open_regular
from bevcli.sequences.format import Format
from bevcli.sequences.options import RigOptions

SUFFIXES = (".mcap", ".db3")
PACKED = (".zst", ".zstd", ".lz4", ".gz", ".xz", ".bz2")
METADATA = "metadata.yaml"


@options("Input")
class BagOptions(RigOptions):
    """The options of a bag."""

    topics: Mapping[str, str] = option(
        default_factory=dict,
        help="ROS bags: the image topic of a camera, where it is not found. Repeatable.",
        flag="--topic",
        metavar="CAMERA=/TOPIC",
        parse=partial(parse_pairs, expected="CAMERA=/TOPIC, such as CAM_FRONT=/camera/front/image_raw"),
        repeatable=True,
    )
    topics_file: Path | None = option(
        reads="path",
        default=None,
        help="ROS bags: topics and frames of a vehicle (docs/other-inputs.md).",
        flag="--topics",
        metavar="FILE.toml",
    )


def is_packed_bag(path: Path) -> bool:
    """True for the name of a compressed bag, such as drive.mcap.zst."""
    return path.suffix in PACKED and path.with_suffix("").suffix in SUFFIXES


def is_ros_bag(path: Path) -> bool:
    """True for an .mcap or .db3 file, or a folder with some."""
    if not path.is_dir():
        return path.suffix in SUFFIXES or is_packed_bag(path)
    if any(file.suffix in SUFFIXES or is_packed_bag(file) for file in path.iterdir()):
        return True
    if not (path / METADATA).is_file():
        return False
    with open_regular(path / METADATA) as file:
        return b"rosbag2_bagfile_information" in file.read(4096)


FORMAT = Format(
    name="a ROS bag",
    expected=".mcap or .db3 files",
    recognises=lambda path: is_ros_bag(path) or path.suffix == ".bag",
    opener="bevcli.workshop.formats.ros.sequence:open_bag",
    options=BagOptions,
    precedence=10,
)
