"""Samples: the frames of a batch of clips as the model's inputs, with what it should say of the last ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from bevcli.errors import InputError
from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import inverse
from bevcli.model.bevformer import BEVFormerConfig, BEVFormerInputs
from bevcli.pipeline.model_inputs import model_inputs
from bevcli.pipeline.preprocess import PreparedFrame, Preprocessor
from bevcli.training.augmentation import AugmentationConfig, distort_images, mask_images
from bevcli.training.clips import Clip
from bevcli.training.detection_targets import DetectionTargets, detection_targets
from bevcli.training.drives import Drives
from bevcli.training.segmentation_targets import SegmentationTargets, segmentation_targets


@dataclass(frozen=True)
class Targets:
    """What a model should say of B frames: B detection and B segmentation targets.

    segmentation is empty where the model has no such head.
    """

    detection: tuple[DetectionTargets, ...]
    segmentation: tuple[SegmentationTargets, ...]

    def to(self, device: torch.device) -> Targets:
        """The same on a device."""
        return Targets(
            tuple(targets.to(device) for targets in self.detection),
            tuple(targets.to(device) for targets in self.segmentation),
        )


@dataclass(frozen=True)
class Batch:
    """B clips of one length. steps: the model's inputs, one a frame. targets: of the last frames of the clips.

    There are fewer targets than steps where the first frames of clips only make history.
    """

    steps: tuple[BEVFormerInputs, ...]
    targets: tuple[Targets, ...]

    def to(self, device: torch.device) -> Batch:
        """The same on a device."""
        steps = tuple(step.to(device) for step in self.steps)
        return Batch(steps, tuple(targets.to(device) for targets in self.targets))


def load_batch(
    drives: Drives,
    clips: list[Clip],
    config: BEVFormerConfig,
    augmentation: AugmentationConfig,
    random: np.random.Generator,
    *,
    learn_all: bool = False,
) -> Batch:
    """Reads, changes and prepares the frames of clips of one length. Raises InputError without ground truth.

    learn_all: give the targets of every frame, not of the last one only.
    """
    loaded = [_load_clip(drives, clip, config, augmentation, random) for clip in clips]
    steps = []
    for number, frames in enumerate(zip(*loaded, strict=True)):
        before = [clip[number - 1].frame.world_from_ego if number else None for clip in loaded]
        inputs = model_inputs(frames, before, config)
        mask_images(inputs.images, augmentation.grid_mask, random)
        steps.append(inputs)
    learned = list(zip(*loaded, strict=True))[0 if learn_all else -1 :]
    return Batch(tuple(steps), tuple(_targets([prepared.frame for prepared in frames], config) for frames in learned))


def _targets(frames: Sequence[Frame], config: BEVFormerConfig) -> Targets:
    truths = [(frame, ground_truth(frame)) for frame in frames]
    segments = "segmentation" in config.heads
    return Targets(
        tuple(detection_targets(boxes, config) for _, boxes in truths),
        tuple(
            segmentation_targets(boxes, frame.ground_truth_map, config.bev_grid) for frame, boxes in truths if segments
        ),
    )


def ground_truth(frame: Frame) -> Boxes3D:
    """The true boxes in the bev frame. Raises InputError where the frame has none."""
    if frame.ground_truth is None:
        raise InputError(
            f"frame {frame.stamp.index} of {frame.stamp.scene or 'the drive'} has no ground truth boxes: "
            "training needs ground_truth.json (bevcli convert writes it)"
        )
    return frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev))


def _load_clip(
    drives: Drives,
    clip: Clip,
    config: BEVFormerConfig,
    augmentation: AugmentationConfig,
    random: np.random.Generator,
) -> list[PreparedFrame]:
    sequence, prepare = drives.open(clip.drive), Preprocessor(config)
    frames = (sequence.load(place) for place in clip.places)
    return [prepare(distort_images(frame, augmentation.photometric, random)) for frame in frames]
