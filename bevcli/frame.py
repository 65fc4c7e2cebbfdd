"""The vocabulary between the parts: what a reader hands over, and what the model answers, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Array, Pose

if TYPE_CHECKING:
    from torch import Tensor

# The bits of a BEV map's cells: a cell may be several at once (design of ground_truth_map/NNNNNN.png).
MAP_CLASSES = {"drivable_road": 1, "lane_boundary": 2, "pedestrian_crossing": 4, "vehicle": 8}


@dataclass(frozen=True)
class CameraImage:
    """One camera's image.

    pixels_bgr: (H, W, 3) uint8, as OpenCV decodes it. encoded: the file's own bytes, where there is a file.
    media_type: of these bytes, "image/jpeg" or "image/png".
    """

    timestamp_ns: int
    pixels_bgr: NDArray[np.uint8]
    encoded: bytes | None = None
    media_type: str | None = None


@dataclass(frozen=True)
class BevMap:
    """What lies on the ground, seen from above in the bev frame.

    cells: (rows, columns) uint8 of MAP_CLASSES' bits; columns from the smallest x to the largest, rows from the
    LARGEST y (ahead, top) to the smallest, as in an image.
    """

    cells: NDArray[np.uint8]
    x_range_m: tuple[float, float]
    y_range_m: tuple[float, float]


@dataclass(frozen=True)
class FrameStamp:
    """When a frame is: `index` is the number that files and the user see; scene "" where there is one only."""

    index: int
    scene: str
    timestamp_ns: int


@dataclass(frozen=True)
class Frame:
    """All that is known of one moment.

    images: by camera, without those that are missing. dropped: camera -> why its image is missing.
    world_from_ego: at the frame's time. world_from_ego_at: at each camera's own time, for every camera of the rig.
    kinematics: at the frame's time. ground_truth: in the world frame. sample_token: nuScenes' name of the frame.
    """

    stamp: FrameStamp
    rig: CameraRig
    images: Mapping[str, CameraImage]
    world_from_ego: Pose
    world_from_ego_at: Mapping[str, Pose]
    kinematics: Kinematics
    dropped: Mapping[str, str] = field(default_factory=dict)
    ground_truth: Boxes3D | None = None
    ground_truth_map: BevMap | None = None
    sample_token: str | None = None


class Sequence(Protocol):
    """A drive, from whatever files. Readers in `bevcli.sequences` follow it.

    `rig` is the first frame's; a frame's own stands in `Frame.rig` (nuScenes' scenes differ). `notes` are what the
    user should be told once (an assumption, a default). Without ego-motion (`has_ego_motion` false) every pose is the
    identity, and boxes can be given in the ego frame only.
    """

    name: str
    rig: CameraRig
    has_ego_motion: bool
    notes: tuple[str, ...]

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """When each frame is, in order; known without decoding an image."""
        ...

    def load(self, place: int) -> Frame:
        """The frame at a place (0 to len(stamps) - 1), its images decoded. Called in order, from one thread.

        An image that cannot be read lands in `Frame.dropped`; other mistakes raise InputError.
        """
        ...


@dataclass(frozen=True)
class CameraSamples:
    """Where spatial cross-attention looked in one camera's image.

    pixels: (K, 2) in the image as it was read (not the network's input), may lie outside of it.
    weights: (K,) attention weights, not negative; over all cameras of a probe they sum to about 1.
    """

    pixels: Array
    weights: Array


@dataclass(frozen=True)
class Probe:
    """One BEV cell that was asked where it looks.

    cell_center: (2,) x, y of its centre in the bev frame, metres. cameras: name -> samples, of the cameras it hits.
    """

    cell_center: Array
    cameras: Mapping[str, CameraSamples]


@dataclass(frozen=True)
class AttentionView:
    """What a frame's attention did, where the model was asked.

    history_weight: (rows, columns) 0 to 1, how much each cell took from the previous BEV map in temporal
    self-attention, rows from the smallest y; None where no history was used. probes: in the order asked for.
    """

    history_weight: Array | None = None
    probes: tuple[Probe, ...] = ()


@dataclass(frozen=True)
class Prediction:
    """What the model says of one frame.

    boxes: all decoded boxes, best first, in the bev frame, with classes and scores.
    bev: (Y*X, C) tensor, cell index row * columns + column, rows from the smallest y; None where no image came.
    started_anew: why no history was used ("first frame", "new scene", …), "" where it was.
    skipped: no image at all; boxes are empty and the state was passed on.
    segmentation: of the model's segmentation head, where it has one. attention: where the run asked for it.
    stage_seconds: time per stage of the pipeline, in the order of the work.
    """

    stamp: FrameStamp
    boxes: Boxes3D
    ego_from_bev: Array
    world_from_ego: Pose
    grid: BevGrid
    bev: Tensor | None
    started_anew: str
    skipped: bool = False
    segmentation: BevMap | None = None
    attention: AttentionView | None = None
    stage_seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def boxes_ego(self) -> Boxes3D:
        """The boxes in the ego frame at the frame's time."""
        return self.boxes.transformed(self.ego_from_bev)

    @property
    def boxes_world(self) -> Boxes3D:
        """The boxes in the world frame. Velocities are over ground already: only their direction turns."""
        return self.boxes.transformed(self.world_from_ego.matrix @ self.ego_from_bev)
