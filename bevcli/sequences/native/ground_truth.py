"""The ground truth of a native folder: boxes in the world frame, and BEV maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from bevcli.frame import BevMap
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, Pose, inverse
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, read_boxes
from bevcli.sequences.files.class_names import ClassNames, count_other_classes, other_classes_note
from bevcli.sequences.files.incremental_json import existing
from bevcli.sequences.files.map_folder import open_maps

BOXES_FILE = "ground_truth.json"
MAPS_FOLDER = "ground_truth_map"


@dataclass(frozen=True)
class GroundTruthUse:
    """How the ground truth of a folder is used.

    Attributes:
        is_read: whether it is read at all.
        class_map: class names in the file -> known classes, see `ClassNames`.
    """

    is_read: bool = True
    class_map: Mapping[str, str] = field(default_factory=dict)


class FolderGroundTruth:
    """ground_truth.json, read at once, and ground_truth_map/, read frame by frame. Either may be missing.

    use: see `GroundTruthUse`.

    Attributes:
        notes: names the classes that are not scored.
    """

    def __init__(self, folder: Path, use: GroundTruthUse = GroundTruthUse()) -> None:
        boxes_path, maps_path = folder / BOXES_FILE, folder / MAPS_FOLDER
        is_read = use.is_read and existing(boxes_path).is_file()
        self._boxes: BoxesFile | None = read_boxes(boxes_path, ClassNames(use.class_map)) if is_read else None
        self.notes = _notes(boxes_path, self._boxes)
        self._frames = {frame.stamp.index: frame for frame in self._boxes.frames} if self._boxes else {}
        self._maps = open_maps(maps_path) if use.is_read and maps_path.is_dir() else None

    def boxes(self, frame: int, world_from_ego: Pose | None, ego_from_bev: Array) -> Boxes3D | None:
        """A frame's boxes in the world frame; None if the file does not have the frame.

        world_from_ego: the sequence's pose at the frame's time. None without ego-motion: boxes are in the ego frame.
        ego_from_bev: (4, 4) of the rig, for a file in the bev frame that does not state its own.
        """
        truth = self._frames.get(frame)
        if truth is None or self._boxes is None:
            return None
        if self._boxes.frame_of_reference == "world":
            return truth.boxes if world_from_ego else _world_to_ego(truth)
        boxes = truth.boxes
        if self._boxes.frame_of_reference == "bev":
            stated = self._boxes.ego_from_bev
            boxes = boxes.transformed(stated.matrix if stated else ego_from_bev)
        return boxes.transformed(world_from_ego.matrix) if world_from_ego else boxes

    def bev_map(self, frame: int) -> BevMap | None:
        """A frame's map, None if there is none."""
        return self._maps.load(frame) if self._maps and self._maps.has(frame) else None


def _notes(path: Path, boxes: BoxesFile | None) -> tuple[str, ...]:
    others = count_other_classes(frame.boxes for frame in boxes.frames) if boxes else None
    return (other_classes_note(others, str(path)),) if others else ()


def _world_to_ego(truth: FrameBoxes) -> Boxes3D | None:
    if truth.world_from_ego is None:
        return None
    return truth.boxes.transformed(inverse(truth.world_from_ego.matrix))
