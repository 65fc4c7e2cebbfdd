"""Training samples: clips drawn from drives, and their frames as network inputs and targets.

As in the paper, the last frame of a clip is trained on; the others are its history.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import Frame, Sequence
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose, inverse
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.step import FrameTruth, ModelInputs, PreparedFrame, model_inputs
from bevcli.model.upload import pinned, upload
from bevcli.sequences.selection import scenes_of
from bevcli.synth.drives import Drives, InputShape
from bevcli.training.augmentation import AugmentationConfig, augmented, mask_images
from bevcli.training.detection_loss import PaddedTargets, box_targets, detection_targets, padded
from bevcli.training.frame_truth import frame_truth
from bevcli.training.pixels import images_as_bytes, images_from_bytes
from bevcli.training.segmentation_loss import PaddedMasks, padded_masks, segmentation_targets

_CHOICE = 8  # drives among which the other clips of a batch are drawn, at least


@dataclass(frozen=True)
class ClipConfig:
    """The [training.clips] table.

    Attributes:
        frames: frames of a clip. The paper's base model uses 4, tiny and small use 3; 1 trains without history.
        batch: clips of a batch.
        short_share: share of the batches with shorter clips (0 to 1), because each scene starts without history.
        learn: "last" trains on the last frame of a clip, as published. "all" trains on every frame of successive
            frames, with one update each; a clip's first frame has no history.
        in_turn: with "all", the number of batches a step. The updates alternate between them, so that successive
            updates do not see the same few streets.
    """

    frames: int = 3
    batch: int = 4
    short_share: float = 0.1
    learn: Literal["last", "all"] = "last"
    in_turn: int = 1

    def __post_init__(self) -> None:
        if min(self.frames, self.batch) < 1 or not 0 <= self.short_share <= 1:
            raise ValueError("frames and batch must be positive, short_share from 0 to 1")
        if self.in_turn < 1 or (self.in_turn > 1 and self.learn != "all"):
            raise ValueError('in_turn must be positive, and 1 unless learn is "all"')

    @property
    def updates(self) -> int:
        """Updates of the weights in a step; fewer in one with shorter clips."""
        return self.in_turn * (self.frames if self.learn == "all" else 1)

    def __str__(self) -> str:
        """A step in words."""
        clips = f"{_counted(self.batch, 'clip', 'clips')} of {_counted(self.frames, 'frame', 'frames')}"
        if self.learn == "last":
            return f"a step is one update of the weights, on {clips}"
        batches = f"{_counted(self.in_turn, 'batch', 'batches')} of {clips}"
        return f"a step is {self.updates} updates of the weights, one for each frame of a batch: {batches}"


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


@dataclass(frozen=True)
class Clip:
    """Some frames of one drive.

    Attributes:
        drive: index of the drive.
        frames: indices of the frames in the drive, ascending.
    """

    drive: int
    frames: tuple[int, ...]


def draw_clips(drives: Drives, config: ClipConfig, random: np.random.Generator, *, with_gap: bool = True) -> list[Clip]:
    """The clips of one batch, all of the same length. Raises InputError if a drive is too short.

    with_gap: with `learn` "last", leave out one of the earlier frames, as published for BEVFormer.
    """
    frames = config.frames
    if frames > 1 and random.random() < config.short_share:
        frames = int(random.integers(1, frames))
    clips: list[Clip] = []
    shapes, leave_out = drives.input_shapes, with_gap and config.learn == "last"
    for _ in range(config.batch):
        alike = range(len(drives)) if not clips or shapes is None else _similar_drives(shapes, clips[0].drive)
        drive = int(alike[random.integers(len(alike))])
        clips.append(Clip(drive, draw_frames(drives.open(drive), frames, random, with_gap=leave_out)))
    return clips


def _similar_drives(shapes: tuple[InputShape, ...], drive: int) -> NDArray[np.intp]:
    """Drives that go into one batch with a drive: with as many cameras, and of these those with the nearest sizes.

    The images of a batch are padded to the largest. At least `_CHOICE` drives, where so many have as many cameras.
    """
    counts, heights, widths = np.array(shapes).T
    differences = np.abs(heights - heights[drive]) + np.abs(widths - widths[drive])
    alike = counts == counts[drive]
    nearest = np.sort(differences[alike])[:_CHOICE]
    return np.flatnonzero(alike & (differences <= nearest[-1]))


def draw_frames(
    sequence: Sequence, count: int, random: np.random.Generator, *, with_gap: bool = True
) -> tuple[int, ...]:
    """Indices of a random frame and of `count` - 1 frames before it in its scene. Raises InputError if there are none.

    with_gap: as published, take the `count` frames before it and leave out a random one.
    """
    scenes = list(scenes_of(sequence.stamps))
    candidates = [(scene, end) for scene in scenes for end in range(count - 1, len(scene))]
    if not candidates:
        raise InputError(f"{sequence.name}: no scene has {count} frames or more, as many as a clip needs")
    scene, end = candidates[int(random.integers(len(candidates)))]
    before = scene[max(0, end - count if with_gap else end - count + 1) : end]
    if len(before) == count:
        del before[int(random.integers(len(before)))]
    return (*before, scene[end])


@dataclass(frozen=True)
class Targets:
    """The targets of B frames, one of each clip.

    Attributes:
        detection: B, the boxes inside the BEV grid.
        perspective: B, all boxes, for the perspective loss.
        segmentation: B, or None if the model has no segmentation head.
        truths: B, for heads of the model's own, on the CPU; empty if it has none.
    """

    detection: PaddedTargets
    perspective: PaddedTargets
    segmentation: PaddedMasks | None
    truths: tuple[FrameTruth, ...] = ()

    def to(self, device: torch.device) -> Targets:
        """A copy on a device."""
        return self._changed(lambda tensor: upload(tensor, device))

    def pinned(self) -> Targets:
        """A copy in memory that a GPU reads by itself."""
        return self._changed(pinned)

    def _changed(self, change: Callable[[Tensor], Tensor]) -> Targets:
        """A copy with other tensors."""

        def changed(part: Any) -> Any:
            tensors = {name: x for name, x in vars(part).items() if isinstance(x, Tensor)}
            return replace(part, **{name: change(x) for name, x in tensors.items()})

        parts = {name: getattr(self, name) for name in ("detection", "perspective", "segmentation")}
        moved: dict[str, Any] = {name: None if part is None else changed(part) for name, part in parts.items()}
        return replace(self, **moved)


@dataclass(frozen=True)
class Batch:
    """B clips of the same length.

    Attributes:
        inputs: the network inputs, one a frame of the clips, each for B clips; images may be in bytes.
        world_from_bev: (frames, B, 4, 4) float64, the poses of the bev frames, metres.
        targets: of the last frames of the clips. There are fewer than inputs if the first frames are history only.
        plain: the same clips before augmentation, for a teacher; None without one.
    """

    inputs: tuple[ModelInputs, ...]
    world_from_bev: Tensor
    targets: tuple[Targets, ...]
    plain: Batch | None = None

    def to(self, device: torch.device) -> Batch:
        """A copy on a device. Projections and poses stay on the CPU, which reads them without waiting for a GPU."""
        inputs = tuple(one.to(device, keep_geometry=True) for one in self.inputs)
        plain = None if self.plain is None else self.plain.to(device)
        return Batch(inputs, self.world_from_bev, tuple(targets.to(device) for targets in self.targets), plain)

    def pinned(self) -> Batch:
        """A copy whose images and targets are in memory that a GPU reads by itself."""
        return replace(self._with_images(pinned), targets=tuple(targets.pinned() for targets in self.targets))

    def normalised(self, image: ImageConfig) -> Batch:
        """The batch with its images normalised, where they are in bytes."""
        in_bytes = self.inputs[0].images.dtype == torch.uint8
        return self._with_images(lambda images: images_from_bytes(images, image)) if in_bytes else self

    def _with_images(self, changed: Callable[[Tensor], Tensor]) -> Batch:
        inputs = tuple(replace(one, images=changed(one.images)) for one in self.inputs)
        return replace(self, inputs=inputs, plain=None if self.plain is None else self.plain._with_images(changed))


def load_batch(
    drives: Drives,
    clips: list[Clip],
    config: ModelConfig,
    augmentation: AugmentationConfig,
    random: np.random.Generator,
    *,
    learn_all: bool = False,
    plain: bool = False,
    in_bytes: bool = False,
) -> Batch:
    """Reads, augments and preprocesses the frames of clips of the same length.

    Args:
        learn_all: give targets for every frame, not for the last one only.
        plain: give the clips before augmentation too.
        in_bytes: give images as bytes, see `images_as_bytes`.

    Raises InputError where a frame to train on has no ground truth.
    """
    loaded = [[drives.open(clip.drive).load(index) for index in clip.frames] for clip in clips]
    frames = _prepared((augmented(of_clip, augmentation, random) for of_clip in loaded), config, in_bytes)
    inputs = _inputs(frames, config)
    for step in inputs:
        mask_images(step.images, augmentation.grid_mask, random)
    learned = range(len(frames)) if learn_all else [len(frames) - 1]
    poses = [[one.frame.world_from_ego.matrix @ one.frame.rig.ego_from_bev for one in prepared] for prepared in frames]
    world_from_bev = torch.from_numpy(np.array(poses))
    targets = []
    for index in learned:
        of_clips = [one.frame for one in frames[index]]
        places = [(drives.open(clip.drive), clip.frames[index]) for clip in clips]
        targets.append(_targets(of_clips, places, config))
    shown = Batch(_inputs(_prepared(loaded, config, in_bytes), config), world_from_bev, ()) if plain else None
    return Batch(inputs, world_from_bev, tuple(targets), shown)


def ground_truth_boxes(frame: Frame) -> Boxes3D:
    """The ground truth boxes in the bev frame. Raises InputError if the frame has none."""
    if frame.ground_truth is None:
        raise InputError(
            f"frame {frame.stamp.index} of {frame.stamp.scene or 'the drive'} has no ground truth boxes: "
            "training needs ground_truth.json (bevcli convert writes it)"
        )
    return frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev))


def _targets(frames: list[Frame], places: list[tuple[Sequence, int]], config: ModelConfig) -> Targets:
    """places: the drive and the place in it of each frame."""
    boxes = [ground_truth_boxes(frame) for frame in frames]
    detection = padded([detection_targets(of_frame, config) for of_frame in boxes])
    perspective = padded([box_targets(of_frame, config.classes) for of_frame in boxes])
    truths: tuple[FrameTruth, ...] = ()
    if config.results:
        truths = tuple(frame_truth(frame, *place, config) for frame, place in zip(frames, places, strict=True))
    if "segmentation" not in config.heads:
        return Targets(detection, perspective, None, truths)
    maps = [frame.ground_truth_map for frame in frames]
    grid, classes = config.bev_grid, config.object_classes
    segmentation = [segmentation_targets(*pair, grid, classes) for pair in zip(boxes, maps, strict=True)]
    return Targets(detection, perspective, padded_masks(segmentation), truths)


def _prepared(clips: Iterable[list[Frame]], config: ModelConfig, in_bytes: bool) -> list[tuple[PreparedFrame, ...]]:
    """For each frame of the clips, that of every clip."""

    def prepared(clip: list[Frame]) -> Iterator[PreparedFrame]:
        for frame in map(Preprocessor(config), clip):
            yield replace(frame, images=images_as_bytes(frame.images, config.image)) if in_bytes else frame

    return list(zip(*([*prepared(clip)] for clip in clips), strict=True))


def _inputs(frames: list[tuple[PreparedFrame, ...]], config: ModelConfig) -> tuple[ModelInputs, ...]:
    poses: list[list[Pose | None]] = [[None] * len(frames[0])]
    poses += [[one.frame.world_from_ego for one in prepared] for prepared in frames[:-1]]
    return tuple(model_inputs(prepared, before, config) for prepared, before in zip(frames, poses, strict=True))
