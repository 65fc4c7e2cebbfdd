"""Training samples: the frames of a batch of clips as network inputs, with the targets of the frames to train on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import inverse
from bevcli.model.bevformer import BEVFormerConfig, BEVFormerInputs
from bevcli.pipeline.model_inputs import model_inputs
from bevcli.pipeline.preprocess import PreparedFrame, Preprocessor
from bevcli.training.augmentation import (
    AugmentationConfig,
    CalibrationVariation,
    ImageVariation,
    distort_images,
    mask_images,
)
from bevcli.training.clips import Clip
from bevcli.training.detection_targets import DetectionTargets, box_targets, detection_targets
from bevcli.training.drives import Drives
from bevcli.training.segmentation_targets import SegmentationTargets, segmentation_targets


@dataclass(frozen=True)
class Targets:
    """The targets of B frames, one of each clip.

    Attributes:
        detection: B, the boxes inside the BEV grid.
        perspective: B, all boxes, for the perspective loss.
        segmentation: B, or empty if the model has no segmentation head.
    """

    detection: tuple[DetectionTargets, ...]
    perspective: tuple[DetectionTargets, ...]
    segmentation: tuple[SegmentationTargets, ...]

    def to(self, device: torch.device) -> Targets:
        """A copy on a device."""
        return Targets(
            tuple(targets.to(device) for targets in self.detection),
            tuple(targets.to(device) for targets in self.perspective),
            tuple(targets.to(device) for targets in self.segmentation),
        )


@dataclass(frozen=True)
class Batch:
    """B clips of the same length.

    Attributes:
        inputs: the network inputs, one a frame of the clips, each for B clips.
        world_from_bev: (frames, B, 4, 4) float64, the poses of the bev frames, metres.
        targets: of the last frames of the clips. There are fewer than inputs if the first frames are history only.
    """

    inputs: tuple[BEVFormerInputs, ...]
    world_from_bev: Tensor
    targets: tuple[Targets, ...]

    def to(self, device: torch.device) -> Batch:
        """A copy on a device. Projections and poses stay on the CPU, which reads them without waiting for a GPU."""
        inputs = tuple(one.to(device, keep_geometry=True) for one in self.inputs)
        targets = tuple(targets.to(device) for targets in self.targets)
        return Batch(inputs, self.world_from_bev, targets)


def load_batch(
    drives: Drives,
    clips: list[Clip],
    config: BEVFormerConfig,
    augmentation: AugmentationConfig,
    random: np.random.Generator,
    *,
    learn_all: bool = False,
) -> Batch:
    """Reads, augments and preprocesses the frames of clips of the same length.

    Args:
        learn_all: give targets for every frame, not for the last one only.

    Raises:
        InputError: a frame to train on has no ground truth.
    """
    loaded = [_load_clip(drives, clip, config, augmentation, random) for clip in clips]
    frames = list(zip(*loaded, strict=True))
    inputs = []
    for index, prepared in enumerate(frames):
        previous_poses = [one.frame.world_from_ego for one in frames[index - 1]] if index else [None] * len(clips)
        step = model_inputs(prepared, previous_poses, config)
        mask_images(step.images, augmentation.grid_mask, random)
        inputs.append(step)
    learned = frames if learn_all else frames[-1:]
    poses = [[one.frame.world_from_ego.matrix @ one.frame.rig.ego_from_bev for one in prepared] for prepared in frames]
    targets = tuple(_targets([one.frame for one in prepared], config) for prepared in learned)
    return Batch(tuple(inputs), torch.from_numpy(np.array(poses)), targets)


def ground_truth_boxes(frame: Frame) -> Boxes3D:
    """The ground truth boxes in the bev frame. Raises InputError if the frame has none."""
    if frame.ground_truth is None:
        raise InputError(
            f"frame {frame.stamp.index} of {frame.stamp.scene or 'the drive'} has no ground truth boxes: "
            "training needs ground_truth.json (bevcli convert writes it)"
        )
    return frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev))


def _targets(frames: Sequence[Frame], config: BEVFormerConfig) -> Targets:
    boxes = [ground_truth_boxes(frame) for frame in frames]
    detection = tuple(detection_targets(of_frame, config) for of_frame in boxes)
    perspective = tuple(box_targets(of_frame, config.classes) for of_frame in boxes)
    if "segmentation" not in config.heads:
        return Targets(detection, perspective, ())
    return Targets(
        detection,
        perspective,
        tuple(
            segmentation_targets(of_frame, frame.ground_truth_map, config.bev_grid)
            for frame, of_frame in zip(frames, boxes, strict=True)
        ),
    )


def _load_clip(
    drives: Drives,
    clip: Clip,
    config: BEVFormerConfig,
    augmentation: AugmentationConfig,
    random: np.random.Generator,
) -> list[PreparedFrame]:
    sequence, preprocess = drives.open(clip.drive), Preprocessor(config)
    vary_images, vary_rig = ImageVariation(augmentation, random), CalibrationVariation(augmentation, random)
    frames = (vary_rig(vary_images(sequence.load(index))) for index in clip.frames)
    return [preprocess(distort_images(frame, augmentation.photometric, random)) for frame in frames]
