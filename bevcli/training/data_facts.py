"""Facts about annotated drives that settings of a model follow from: classes, cameras, frame rate, range of boxes."""

from collections import Counter
from collections.abc import Sequence as Items
from dataclasses import dataclass

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Frame, Sequence
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig, level_rig
from bevcli.geometry.transforms import Array, inverse
from bevcli.model.config import BevFrameConfig
from bevcli.sequences.selection import scenes_of, select_rate
from bevcli.training.drive_checks import longest_scene

INSIDE_PERCENT = 95.0  # of the boxes that the BEV range takes in


@dataclass(frozen=True)
class DataFacts:
    """What some drives contain.

    Attributes:
        drives: the drives, with all their frames.
        frames: number of frames with ground truth.
        class_counts: number of boxes by class, the most frequent first.
        class_sizes: median length, width and height of the boxes by class, metres.
        rigs: the rig of each drive.
        rate_hz: median rate of the frames with ground truth, per second.
        centers_bev: (N, 3) centres of all boxes in the bev frame, metres.
        map_reach_m: distance that all ground-truth maps cover to each side, metres; 0 without maps.
    """

    drives: tuple[Sequence, ...]
    frames: int
    class_counts: dict[str, int]
    class_sizes: dict[str, tuple[float, float, float]]
    rigs: tuple[CameraRig, ...]
    rate_hz: float
    centers_bev: Array
    map_reach_m: float

    @property
    def cameras(self) -> tuple[str, ...]:
        """The names of the cameras of all rigs."""
        return tuple(dict.fromkeys(name for rig in self.rigs for name in rig.names))

    @property
    def image_size(self) -> tuple[int, int]:
        """The most frequent width and height of the images, pixels."""
        sizes = Counter((camera.width, camera.height) for rig in self.rigs for camera in rig.cameras)
        return sizes.most_common(1)[0][0]

    @property
    def reach_m(self) -> float:
        """Half the side of a square around the vehicle that holds 95 % of the boxes, metres."""
        return float(np.percentile(np.abs(self.centers_bev[:, :2]).max(axis=1), INSIDE_PERCENT))

    def shortest(self, rate_hz: float) -> int:
        """Frames of the longest scene of the shortest drive, at a frame rate."""
        return min(longest_scene(select_rate(drive, rate_hz)) for drive in self.drives)


def look_at(drives: Items[Sequence], bev_frame: BevFrameConfig) -> DataFacts:
    """Read the ground truth of all frames of some drives. Raises InputError where there is none, or no box.

    bev_frame: of the model, for the centres of the boxes.
    """
    labelled: list[Boxes3D] = []
    gaps_s: list[Array] = []
    map_reaches: list[float] = []
    for drive in drives:
        frames = [drive.ground_truth_frame(place) for place in range(len(drive.stamps))]
        frames = [frame for frame in frames if frame.ground_truth is not None]
        if not frames:
            raise InputError(f"{drive.name}: has no ground truth boxes (expected for training): leave it out")
        labelled += [_boxes_bev(frame, bev_frame) for frame in frames]
        stamps = [frame.stamp for frame in frames]
        gaps_s += [np.diff([stamps[i].timestamp_ns for i in scene]) / 1e9 for scene in scenes_of(stamps)]
        maps = [frame.ground_truth_map for frame in frames if frame.ground_truth_map is not None]
        map_reaches += [min(abs(end) for end in (*each.x_range_m, *each.y_range_m)) for each in maps]
    names = np.concatenate([boxes.classes for boxes in labelled])
    if not len(names):
        raise InputError(f"the {len(drives)} drives have no boxes (expected some to train on)")
    counts = dict(Counter(names.tolist()).most_common())
    sizes = np.concatenate([boxes.sizes_lwh for boxes in labelled])
    medians = {name: tuple(np.median(sizes[names == name], axis=0).tolist()) for name in counts}
    gaps = np.concatenate(gaps_s)
    rate_hz = 1 / float(np.median(gaps)) if len(gaps) else 2.0
    rigs = tuple(drive.rig for drive in drives)
    reach_m = min(map_reaches, default=0.0)
    centers = np.concatenate([boxes.centers for boxes in labelled])
    return DataFacts(tuple(drives), len(labelled), counts, medians, rigs, rate_hz, centers, reach_m)


def _boxes_bev(frame: Frame, bev_frame: BevFrameConfig) -> Boxes3D:
    """The ground truth of a frame in the bev frame of the model."""
    rig = level_rig(frame.rig, bev_frame.height_m) if bev_frame.level else frame.rig
    assert frame.ground_truth is not None
    return frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix @ rig.ego_from_bev))
