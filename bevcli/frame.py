"""The types that pass between the parts: a frame as readers return it, and a prediction as the model returns it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import IMPOSSIBLE, Boxes2D, Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion, Kinematics
from bevcli.geometry.object_classes import NUSCENES_CLASSES, SHOWN_SCORE, Color, ObjectClass
from bevcli.geometry.transforms import Array, GeoOrigin, Pose, apply, inverse
from bevcli.printing import counted, valid_text

if TYPE_CHECKING:
    from torch import Tensor

BLANK_STEP, BLANK_LEVELS = 16, 8  # pixels; grey levels between which those of an image are that shows nothing
MOST_MAP_CLASSES = 8  # a BEV map has one bit for each class


ColorOrder = Literal["bgr", "rgb"]


def check_color_order(color_order: str) -> None:
    """Raise InputError for another color order than those of `ColorOrder`."""
    if color_order not in ("bgr", "rgb"):
        raise InputError(f'`color_order={color_order}`: expected "bgr" or "rgb"')


def class_bits(names: Iterable[str]) -> dict[str, int]:
    """The bits of map classes in the cells of a BEV map: class -> 1, 2, 4 and so on, in their order."""
    return {name: 1 << index for index, name in enumerate(names)}


# The map classes of rendered drives and of the segmentation head.
MAP_CLASSES = class_bits(["drivable_road", "lane_boundary", "pedestrian_crossing", "vehicle"])


@dataclass(frozen=True)
class CameraImage:
    """One camera's image.

    Attributes:
        timestamp_ns: when it was taken.
        pixels_bgr: (H, W, 3) uint8, as OpenCV decodes it.
        encoded: the bytes of the image file, None where there is no file.
        media_type: of `encoded`, "image/jpeg" or "image/png".
    """

    timestamp_ns: int
    pixels_bgr: NDArray[np.uint8]
    encoded: bytes | None = None
    media_type: str | None = None

    @cached_property
    def is_blank(self) -> bool:
        """It shows nothing: all of it has one colour, as of a dead camera."""
        some = self.pixels_bgr[::BLANK_STEP, ::BLANK_STEP]
        return int(np.ptp(some, axis=(0, 1)).max()) <= BLANK_LEVELS


@dataclass(frozen=True)
class BevMap:
    """A map of the ground in the bev frame.

    Attributes:
        cells: (rows, columns) uint8, the bits of the classes; a cell may belong to several. Columns run from the
            smallest x to the largest, rows from the LARGEST y (ahead, top) to the smallest, as in an image.
        x_range_m: smallest and largest x, metres.
        y_range_m: smallest and largest y, metres.
        classes: class -> its bit.
    """

    cells: NDArray[np.uint8]
    x_range_m: tuple[float, float]
    y_range_m: tuple[float, float]
    classes: Mapping[str, int] = field(default_factory=lambda: MAP_CLASSES)

    def layer(self, name: str) -> NDArray[np.bool_]:
        """(rows, columns) bool, the cells of a class; all False for a class that the map does not have."""
        return (self.cells & np.uint8(self.classes.get(name, 0))) > 0

    def painted(self, colors: Mapping[str, Color], background: Color) -> NDArray[np.uint8]:
        """(rows, columns, 3) RGB: each cell in the colour of the last of its classes, by their order in `colors`."""
        palette = np.full((256, 3), background, dtype=np.uint8)
        for name, color in colors.items():
            palette[(np.arange(256) & self.classes.get(name, 0)) > 0] = color
        return palette.take(self.cells, axis=0)


@dataclass(frozen=True)
class GroundLines:
    """N lines on the ground, as recordings draw them."""

    strips: list[Array] = field(default_factory=list)  # N lines (K, 3) in the world frame, metres
    colors: list[tuple[int, int, int, int]] = field(default_factory=list)  # N colours, RGB and opacity, 0 to 255
    width: float = 1.0  # in points of the user interface


class FrameResult:
    """A further result of a model for one frame, or its ground truth.

    Each type of results is a subclass. It brings its file, its drawing and its entries of the legend;
    `ModelConfig.results` states the types that a model has, with their names.

    Attributes:
        kind: last part of its entities in a recording, such as "map_lines".
        file_name: of its file in the folder of a run.
        writer: kind of `GrowingFile`, made of a path, `frame_of_reference` ("world" or "ego"), `extras` (facts of the
            run, "classes" with the names among them) and `resume_at`. Its method `write(ground, result)` adds a frame;
            the result is None where the model was not run.
        takes_command: its names are commands of the driver, see `with_command`.
        true_file: of its ground truth in a native sequence folder, which `writer` makes; "" without.
        true_names: of its ground truth.
    """

    kind: ClassVar[str]
    file_name: ClassVar[str]
    writer: ClassVar[type[Any]]
    takes_command: ClassVar[bool] = False
    true_file: ClassVar[str] = ""
    true_names: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def legend(cls, names: tuple[str, ...]) -> dict[str, Color]:
        """Entries of the legend: text -> colour."""
        raise NotImplementedError

    def drawn(self, ground: "Ground", names: tuple[str, ...], score: float) -> GroundLines:
        """Its drawing. score: what has a lower one is hidden."""
        raise NotImplementedError

    def with_command(self, command: str) -> Self:
        """The result where the driver gives a command, "" for none."""
        return self


Kind = TypeVar("Kind", bound=FrameResult)


def result_of(kind: type[Kind], results: Iterable[FrameResult]) -> Kind | None:
    """The result of a type, or None."""
    return next((result for result in results if isinstance(result, kind)), None)


@dataclass(frozen=True)
class FrameStamp:
    """The identity and the time of a frame.

    Attributes:
        index: the number of the frame in files and on the command line.
        scene: the name of its scene, "" where the sequence has only one.
        timestamp_ns: its time.
    """

    index: int
    scene: str
    timestamp_ns: int


def _named(stamp: FrameStamp) -> str:
    """A frame in words, for one line."""
    return f"frame {stamp.index}" + (f" of {stamp.scene}" if stamp.scene else "")


@dataclass(frozen=True)
class Frame:
    """The sensor data and the ground truth of one moment.

    Attributes:
        stamp: identity and time.
        rig: the cameras.
        images: camera -> image; missing images are left out.
        world_from_ego: the vehicle's pose at the frame's time.
        world_from_ego_at: camera -> the vehicle's pose at that camera's own time, for every camera of the rig.
        kinematics: acceleration, angular rate and velocity at the frame's time.
        dropped: camera -> why its image is missing.
        road_normal: (3,) unit vector that points up from the road, ego frame; None for the ego frame's z axis.
        ground_truth: boxes in the world frame.
        ground_truth_map: a map in the bev frame.
        ground_truth_results: further ground truth in the bev frame, each of another type.
        sample_token: nuScenes' name of the frame.
        impossible_boxes: number of ground-truth boxes that were left out: a size of 0 or less, or not finite.
    """

    stamp: FrameStamp
    rig: CameraRig
    images: Mapping[str, CameraImage]
    world_from_ego: Pose
    world_from_ego_at: Mapping[str, Pose]
    kinematics: Kinematics
    dropped: Mapping[str, str] = field(default_factory=dict)
    road_normal: Array | None = None
    ground_truth: Boxes3D | None = None
    ground_truth_map: BevMap | None = None
    ground_truth_results: tuple[FrameResult, ...] = ()
    sample_token: str | None = None
    impossible_boxes: int = 0

    @property
    def warnings(self) -> list[str]:
        """Texts on missing images and true boxes that were left out; a recording logs its own events."""
        where = f"frame {self.stamp.index}"
        texts = [f"{where}: camera {camera} has no image: {why}" for camera, why in self.dropped.items()]
        if self.impossible_boxes:
            texts.append(f"{where}: {counted(self.impossible_boxes, 'true boxes')} {IMPOSSIBLE}")
        return texts

    def sees(self, boxes: Boxes3D) -> NDArray[np.bool_]:
        """(N,) bool, boxes of the world frame whose foot, middle or top is in an image that is not blank."""
        points = boxes.centers[:, None] + boxes.sizes_lwh[:, None, 2:] * [[0, 0, -0.5], [0, 0, 0], [0, 0, 0.5]]
        seen = np.zeros(len(boxes), dtype=bool)
        for name, image in self.images.items():
            if image.is_blank:
                continue
            in_ego = apply(inverse(self.world_from_ego_at[name].matrix), points)  # (N, 3, 3)
            seen |= self.rig[name].sees(in_ego).any(-1)
        return seen

    def __repr__(self) -> str:
        truth = "" if self.ground_truth is None else f", {len(self.ground_truth)} true boxes"
        return f"Frame({_named(self.stamp)}, images of {', '.join(self.images) or 'no camera'}{truth})"


@dataclass(frozen=True)
class DriveFacts:
    """Statements of a drive about itself, beyond its frames."""

    rendered: bool = False  # whether `bevcli render` made its images
    geo_origin: GeoOrigin | None = None  # where its world frame is on Earth, None if it does not say
    motion_measured: bool = False  # whether its poses are measured from its images


class Drive(Protocol):
    """A drive: frames in order. A reader inherits it for the attributes that have a default.

    Attributes:
        name: of the drive, for output folders and titles.
        rig: the cameras of the first frame; `Frame.rig` holds each frame's own (nuScenes' scenes differ).
        stamps: identity and time of each frame, in order. No image is decoded for this.
        has_ego_motion: whether poses are known. If not, every pose is the identity, and boxes can be given in the ego
            frame only.
        notes: assumptions and defaults that the user should be told once.
        facts: statements of the drive about itself.
        ego_motion: the poses of the whole drive, where it has them in one table; else None.
    """

    name: str
    rig: CameraRig
    stamps: tuple[FrameStamp, ...]
    has_ego_motion: bool
    notes: tuple[str, ...] = ()
    facts: DriveFacts = DriveFacts()
    ego_motion: EgoMotion | None = None

    def __repr__(self) -> str:
        count, cameras = len(self.stamps), len(self.rig.cameras)
        return f"{type(self).__name__}({self.name}, {counted(count, 'frames')}, {counted(cameras, 'cameras')})"

    @property
    def input_files(self) -> tuple[Path, ...]:
        """The files that a resumed run needs unchanged, such as tables and bags; image files are not among them."""
        return ()

    @property
    def class_counts(self) -> Mapping[str, int]:
        """Number of ground-truth boxes of the drive by class, where they are in one table; else empty."""
        return {}

    def image_files(self, index: int) -> tuple[Path, ...]:
        """The image files and videos of the frame at an index; none where its images are in `input_files`."""
        return ()

    def ground_truth_frame(self, index: int) -> Frame:
        """The frame at an index for scoring: it needs no images. By default it has them, as from `load`."""
        return self.load(index)

    def load(self, index: int) -> Frame:
        """The frame at a place (0 to len(stamps) - 1), with decoded images. Called in order, from one thread.

        An image that cannot be read is listed in `Frame.dropped`; other mistakes raise InputError.
        """
        ...


Sequence = Drive  # the name that version 0.2 had for it


class DerivedDrive(Drive):
    """A drive made from another one, with all that the other states. A subclass changes some of it.

    A subclass that changes frames overrides `change`, or `load`, which then gives the frames for scoring too.
    """

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.name, self.rig, self.stamps = valid_text(drive.name), drive.rig, drive.stamps
        self.has_ego_motion, self.notes, self.facts = drive.has_ego_motion, drive.notes, drive.facts
        self.ego_motion = drive.ego_motion

    @property
    def input_files(self) -> tuple[Path, ...]:
        return self.drive.input_files

    @property
    def class_counts(self) -> Mapping[str, int]:
        return self.drive.class_counts

    def image_files(self, index: int) -> tuple[Path, ...]:
        return self.drive.image_files(index)

    def change(self, index: int, frame: Frame) -> Frame:
        """The frame at an index with its changes; for scoring it may have no images."""
        return frame

    def ground_truth_frame(self, index: int) -> Frame:
        if type(self).load is not DerivedDrive.load:
            return self.load(index)
        return self.change(index, self.drive.ground_truth_frame(index))

    def load(self, index: int) -> Frame:
        return self.change(index, self.drive.load(index))


@dataclass(frozen=True)
class CameraSamples:
    """The sampling points of spatial cross-attention in one camera's image."""

    pixels: Array  # (K, 2) x, y in the image as read (not the network's input); may lie outside of it
    weights: Array  # (K,) attention weights, 0 or larger; over all cameras of a probe they sum to about 1


@dataclass(frozen=True)
class Probe:
    """The sampling points of one BEV cell."""

    cell_center: Array  # (2,) x, y of the cell's centre in the bev frame, metres
    cameras: Mapping[str, CameraSamples]  # camera -> sampling points, for the cameras that see the cell's pillar


@dataclass(frozen=True)
class AttentionView:
    """Samples of the attentions of the last encoder layer."""

    # (rows, columns) 0 to 1, the share of the previous BEV map in what temporal self-attention sampled for each cell;
    # rows from the smallest y. None where no history was used
    history_weight: Array | None = None
    probes: tuple[Probe, ...] = ()  # one a probed cell, in the order of the request


@dataclass(frozen=True)
class Ground:
    """The ground at a frame's time, z = 0 of the ego frame, below places of the bev frame.

    Attributes:
        stamp: of the frame.
        ego_from_bev: (4, 4).
        world_from_ego: the vehicle's pose; None if unknown, or where points are to be in the ego frame.
    """

    stamp: FrameStamp
    ego_from_bev: Array
    world_from_ego: Pose | None

    def points(self, places: Array) -> Array:
        """Points (..., 3) on the ground in the world frame, or the ego frame without pose.

        places: (..., 2) x and y in the bev frame, metres.
        """
        below = np.full((*places.shape[:-1], 1), -self.ego_from_bev[2, 3])
        in_ego = apply(self.ego_from_bev, np.concatenate([places, below], axis=-1)) * (1, 1, 0)
        return in_ego if self.world_from_ego is None else apply(self.world_from_ego.matrix, in_ego)


class StartReason(Enum):
    """A reason to step without history."""

    HISTORY_OFF = "history is off"
    NO_HISTORY = "the model uses no history"
    FIRST_FRAME = "first frame"
    NEW_SCENE = "new scene"
    GAP = "gap"


@dataclass(frozen=True)
class NewStart:
    """A step without history. Its text is "first frame", "gap of 2.5 s" and so on."""

    reason: StartReason  # for it
    gap_s: float = 0.0  # time since the frame before, with StartReason.GAP

    def __str__(self) -> str:
        return f"gap of {self.gap_s:.1f} s" if self.reason is StartReason.GAP else self.reason.value


@dataclass(frozen=True)
class Prediction:
    """The model's results for one frame.

    Attributes:
        stamp: of the frame.
        boxes: all boxes, remembered ones included, bev frame, highest score first, with classes and scores.
        ego_from_bev: (4, 4) pose of the bev frame in the ego frame.
        world_from_ego: the vehicle's pose at the frame's time.
        grid: the BEV grid.
        bev: (Y·X, C) tensor, the BEV feature map; cell index row * columns + column, rows from the smallest y. None
            where the frame has no image or its numbers are not finite.
        started_anew: the reason why no history was used; None where it was used.
        camera_embeddings: camera of the rig -> camera of the model whose embedding it took, in the model's order.
        skipped: whether the frame has no image at all: no boxes, and the history is kept.
        not_finite: the part of the model where numbers became NaN or infinite, such as "encoder layer 3 (…)": the frame
            has no boxes, and the history starts anew. "" where all numbers are finite.
        segmentation: the map of the segmentation head, None without one.
        attention: what the attentions sampled, where this was asked for.
        stage_seconds: stage of the pipeline -> seconds, in the order of execution.
        results: further results of the model, each of another type.
        image_boxes: camera -> boxes in its image, of the cameras with an image; None where the model has no detector.
        object_classes: of the model, by name.
        frame: that it is for, with its images, which `plot` draws; None where it was left out.
        untrained: whether the weights are random: boxes and maps are meaningless.
    """

    stamp: FrameStamp
    boxes: Boxes3D
    ego_from_bev: Array
    world_from_ego: Pose
    grid: BevGrid
    bev: "Tensor | None"
    started_anew: NewStart | None
    camera_embeddings: Mapping[str, str] = field(default_factory=dict)
    skipped: bool = False
    not_finite: str = ""
    segmentation: BevMap | None = None
    attention: AttentionView | None = None
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    results: tuple[FrameResult, ...] = ()
    image_boxes: Mapping[str, Boxes2D] | None = None
    object_classes: Mapping[str, ObjectClass] = field(default_factory=lambda: NUSCENES_CLASSES)
    frame: Frame | None = None
    untrained: bool = False

    def __repr__(self) -> str:
        found = self.failure or f"{len(self.boxes)} boxes"
        further = (*(["map"] if self.segmentation is not None else []), *(each.kind for each in self.results))
        return f"Prediction({', '.join((_named(self.stamp), found, *further))})"

    def plot(
        self, image: str | None = None, *, score: float = SHOWN_SCORE, color_order: ColorOrder = "bgr"
    ) -> NDArray[np.uint8]:
        """The images of the frame with the boxes, and the map from above, as one image (H, W, 3) uint8.

        Args:
            image: a camera, for its image alone, in its own size.
            score: boxes scored below this are left out.
            color_order: of the result: "bgr", as OpenCV writes it, or "rgb".

        Raises InputError for an unknown camera or color order, and where `frame` is None.
        """
        from bevcli.workshop.plot import plot

        return plot(self, image, score, color_order)

    @property
    def failure(self) -> str:
        """The reason why the model found nothing in the frame, and what becomes of the history; "" where it ran."""
        if self.skipped:
            return "no camera has an image; the model was not run, the history is kept"
        return f"NaN or infinity in {self.not_finite}; no boxes, the history starts anew" if self.not_finite else ""

    @property
    def ground(self) -> "Ground":
        """The ground below the bev frame."""
        return Ground(self.stamp, self.ego_from_bev, self.world_from_ego)

    @cached_property
    def boxes_ego(self) -> Boxes3D:
        """The boxes in the ego frame at the frame's time."""
        return self.boxes.transformed(self.ego_from_bev)

    @cached_property
    def boxes_world(self) -> Boxes3D:
        """The boxes in the world frame. Velocities are over ground in every frame; only their direction changes."""
        return self.boxes.transformed(self.world_from_ego.matrix @ self.ego_from_bev)
