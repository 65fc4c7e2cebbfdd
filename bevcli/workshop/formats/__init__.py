"""Formats of other programs: drives, labels and boxes, and `convert`.

Here is what recognises a drive of each format, and all options; a reader is imported when it is chosen.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bevcli.errors import InputError
from bevcli.geometry.object_classes import SHOWN_SCORE
from bevcli.options import option, options, parse_pairs
from bevcli.parsing.files import VIDEO_SUFFIXES, open_regular
from bevcli.sequences.format import Format
from bevcli.sequences.native import FolderOptions
from bevcli.sequences.options import InputOptions, RigOptions

if TYPE_CHECKING:
    from bevcli.frame import Drive

# Any of these makes a folder a log of Argoverse 2, so that an incomplete one gets an error that names the missing file.
ARGOVERSE2_FILES = (
    "city_SE3_egovehicle.feather",
    "calibration/egovehicle_SE3_sensor.feather",
    "calibration/intrinsics.feather",
)
DGP_FOLDERS = ("calibration", "ontology", "rgb")  # a folder with these is a scene that lacks its file
T4_TABLES = ("scene", "sample", "sample_data")  # any of them makes a folder a T4 dataset
NATIVE_FILES = ("calibration.json", "frames.csv", "ego_motion.csv")
AXLE_HEIGHT_M = 0.33
BAG_SUFFIXES = (".mcap", ".db3")
PACKED = (".zst", ".zstd", ".lz4", ".gz", ".xz", ".bz2")
BAG_METADATA = "metadata.yaml"
BAG_PACKAGES = ("mcap", "rosbags", "google.protobuf")
UnlistedFrames = Literal["empty", "unlabelled"]


@options("Input")
class Argoverse2Options(Format):
    """An Argoverse 2 log."""

    name = "an Argoverse 2 log"
    expected = "city_SE3_egovehicle.feather"
    reader = "bevcli.workshop.formats.argoverse2:open_log"
    annotated = True

    stereo: bool = option(default=False, help="Argoverse 2: also use the two stereo cameras.")
    distorted: bool = option(
        default=False, help="Argoverse 2: the images have the lens distortion k1 to k3. The published images have none."
    )
    axle_height_m: float = option(
        default=AXLE_HEIGHT_M, help="Argoverse 2: height of the rear axle above the ground, metres.", metavar="M"
    )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a folder with a file of a log."""
        return any((path / marker).exists() for marker in ARGOVERSE2_FILES)


@options("Input")
class DgpScene(Format):
    """A scene of a DGP dataset."""

    name = "a DGP scene"
    expected = "scene_*.json"
    reader = "bevcli.workshop.formats.dgp:open_scene"
    annotated = True

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a folder with the file of a scene, or with the folders of one that lacks its file."""
        return any(path.glob("scene_*.json")) or all((path / name).is_dir() for name in DGP_FOLDERS)


@options("Input")
class NuScenesOptions(Format):
    """A nuScenes root, and the part of it that is read."""

    name = "a nuScenes root"
    expected = "v1.0-*/scene.json"
    reader = "bevcli.workshop.formats.nuscenes:NuScenesDrive"
    annotated = True
    precedence = 20

    version: str | None = option(
        default=None, help="nuScenes: dataset version, such as v1.0-mini. Default: the only one present."
    )
    split: str | None = option(
        default=None, help="nuScenes: only scenes of this split (train, val, test, mini_train, mini_val)."
    )
    sweeps: bool = option(
        default=False, help="nuScenes: also read the images between keyframes (12 frames per second)."
    )

    @property
    def wants_all_frames(self) -> bool:
        """With sweeps, every frame is kept unless a rate is given."""
        return self.sweeps

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True if a folder contains the tables of a nuScenes version."""
        return is_nuscenes_root(path)


@options("Input")
class T4Dataset(Format):
    """A T4 dataset."""

    name = "a T4 dataset"
    expected = "annotation/sample_data.json"
    reader = "bevcli.workshop.formats.nuscenes:open_t4"
    annotated = True

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a folder with a table of a T4 dataset."""
        return any((path / "annotation" / f"{name}.json").exists() for name in T4_TABLES)


@options("Input")
class KittiDrive(FolderOptions, Format):
    """A drive of KITTI odometry, KITTI raw or KITTI-360."""

    name = "a KITTI drive"
    expected = "image_2 and calib.txt, or image_02/data"
    reader = "bevcli.workshop.formats.kitti:open_kitti"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a folder with KITTI's folders of images, unless it has a file of a sequence folder."""
        if not path.is_dir() or any((path / name).exists() for name in NATIVE_FILES):
            return False
        if any((path / f"image_0{number}" / name).is_dir() for number in range(4) for name in ("data", "data_rect")):
            return True
        has_images = any((path / f"image_{number}").is_dir() for number in range(4))
        if has_images and ((path / "calib.txt").exists() or (path / "times.txt").exists()):
            return True
        return path.parent.name.startswith("image_0") and (path.parent.parent / f"calib/{path.name}.txt").exists()


@options("Input")
class VideoFile(FolderOptions, Format):
    """A drive that is a video of one camera."""

    name = "a video"
    expected = ".mp4, .mkv, .avi, .webm, .mov, .m4v, .ts, .mts or .m2ts"
    reader = "bevcli.workshop.formats.video_file:open_video"
    has_poses = False

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a video, by its name."""
        return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


@options("Input")
class BagOptions(RigOptions, Format):
    """A ROS 2 bag or an MCAP file."""

    name = "a ROS bag"
    expected = ".mcap or .db3 files"
    reader = "bevcli.workshop.formats.ros.sequence:open_bag"
    precedence = 10

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

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a bag, also one of ROS 1, which its reader refuses."""
        return is_ros_bag(path) or path.suffix == ".bag"

    def open(self, path: Path, common: InputOptions) -> Drive:
        """A bag as a drive. Raises InputError where the packages of the extra `ros` are not installed."""
        try:
            installed = all(map(find_spec, BAG_PACKAGES))
        except ModuleNotFoundError:  # the package around one of them
            installed = False
        if not installed:
            raise InputError(f"{path}: ROS bags need the packages of an extra: run pip install 'bevcli[ros]'")
        return super().open(path, common)


@options("Input")
class LabelOptions:
    """Ground truth from a file of labels."""

    labels: Path | None = option(
        reads="path",
        default=None,
        help="Ground truth in place of that of INPUT: a CSV table with the columns of `bevcli export --format csv`, "
        "or KITTI labels.",
        metavar="FILE",
    )
    unlisted_frames: UnlistedFrames | None = option(
        default=None,
        help="Frames without a row in a table of labels are empty, or not labelled. Default: empty, unless no two "
        "successive frames have rows; then only every n-th frame is labelled.",
    )
    labels_camera: str | None = option(
        default=None,
        help="The camera in whose frame KITTI labels are. Default: image_2, or the one that the images show.",
        metavar="NAME",
    )
    labels_frame: Literal["ego", "world", "bev"] | None = option(
        default=None,
        help="The frame of the boxes in a table of labels. Default: column frame_of_reference, or what the boxes show.",
    )
    labels_sides: Literal["lwh", "lhw", "wlh", "whl", "hlw", "hwl"] | None = option(
        default=None,
        help="What columns length, width and height of a table of labels hold: wlh for width, length, height. Default: "
        "what the boxes show.",
    )
    labels_yaw: Literal["x", "y", "clockwise", "compass", "kitti"] | None = option(
        default=None,
        help="Yaw in a table of labels: counter-clockwise from x or y, clockwise from x, compass (clockwise from y) or "
        "kitti (its rotation_y). Default: what the boxes show.",
    )
    labels_yaw_unit: Literal["radians", "degrees"] | None = option(
        default=None, help="Unit of yaw in a table of labels. Default: what the boxes show."
    )
    labels_z: Literal["center", "bottom"] | None = option(
        default=None, help="Point of a box whose z a table of labels has. Default: what the boxes show."
    )


@options()
class WriteOptions:
    """The options of a drive that is written."""

    form: str = option(
        default="native",
        help="native: a sequence folder. nuscenes: a nuScenes root. mcap: one file for Foxglove and ROS 2, with boxes.",
        flag="--format",
        metavar="NAME",
        complete=lambda incomplete: ["mcap", "native", "nuscenes"],
    )
    force: bool = option(default=False, help="Overwrite an existing drive in OUT.")
    boxes: Path | None = option(
        reads="path", default=None, help="mcap: also write the boxes of this run (a folder or predictions.json)."
    )
    score: float = option(
        default=SHOWN_SCORE, help="mcap: leave out boxes of the run scored below this.", minimum=0, maximum=1
    )


@options()
class ExportOptions:
    """The format of exported boxes and what it needs."""

    form: str = option(
        help="csv: one table. json: a boxes file, as predictions.json. kitti: label_2 and calib. "
        "nuscenes: results_nusc.json. nuscenes-tracking: tracking_nusc.json.",
        flag="--format",
        metavar="NAME",
        complete=lambda incomplete: ["csv", "json", "kitti", "nuscenes", "nuscenes-tracking"],
    )
    out: Path | None = option(
        default=None, help="Default: a name that depends on the format, such as boxes.csv, next to PREDICTIONS."
    )
    score: float = option(default=0.0, help="Leave out boxes scored below this.", minimum=0, maximum=1)
    calibration: Path | None = option(
        reads="path",
        default=None,
        help="kitti: calibration.json, or the sequence folder that contains it. Default: the one next to PREDICTIONS.",
    )
    camera: str | None = option(
        default=None, help="kitti: the camera. Default: CAM_FRONT, else the one that looks most directly ahead."
    )


def versions_in(root: Path) -> list[str]:
    """The versions whose tables a folder contains, such as "v1.0-mini" for ROOT/v1.0-mini/scene.json."""
    return sorted(path.parent.name for path in root.glob("v1.*/scene.json"))


def is_nuscenes_root(path: Path) -> bool:
    """True if a folder contains the tables of a nuScenes version."""
    return bool(versions_in(path))


def is_packed_bag(path: Path) -> bool:
    """True for the name of a compressed bag, such as drive.mcap.zst."""
    return path.suffix in PACKED and path.with_suffix("").suffix in BAG_SUFFIXES


def is_ros_bag(path: Path) -> bool:
    """True for an .mcap or .db3 file, or a folder with some."""
    if not path.is_dir():
        return path.suffix in BAG_SUFFIXES or is_packed_bag(path)
    if any(file.suffix in BAG_SUFFIXES or is_packed_bag(file) for file in path.iterdir()):
        return True
    if not (path / BAG_METADATA).is_file():
        return False
    with open_regular(path / BAG_METADATA) as file:
        return b"rosbag2_bagfile_information" in file.read(4096)
