"""Training samples: clips drawn from drives, and their frames as network inputs and targets.

As in the paper, the last frame of a clip is trained on; the others are its history.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence as Items
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import Frame, Sequence
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import inverse
from bevcli.inference.preprocess import Preprocessor, write_network_image
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.step import ModelInputs, PreparedFrame, joined_inputs, model_inputs
from bevcli.model.temporal_model import model_class
from bevcli.model.upload import pinned, upload
from bevcli.printing import counted
from bevcli.registry import for_model
from bevcli.sequences.open import scenes_of
from bevcli.workshop.synth.drives import Drives, InputShape
from bevcli.workshop.training.augmentation import AugmentationConfig, augmented, mask_images
from bevcli.workshop.training.detection_loss import PaddedTargets, box_targets, detection_targets, padded
from bevcli.workshop.training.segmentation_loss import PaddedMasks, padded_masks, segmentation_targets

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
        clips = f"{counted(self.batch, 'clips')} of {counted(self.frames, 'frames')}"
        if self.learn == "last":
            return f"a step is one update of the weights, on {clips}"
        batches = f"{counted(self.in_turn, 'batches')} of {clips}"
        return f"a step is {self.updates} updates of the weights, one for each frame of a batch: {batches}"


@dataclass(frozen=True)
class Clip:
    """Some frames of one drive.

    Attributes:
        drive: index of the drive.
        frames: indices of the frames in the drive, ascending.
    """

    drive: int
    frames: tuple[int, ...]


def draw_clip(
    drives: Drives, config: ClipConfig, seed: Items[int], index: int, *, with_gap: bool = True
) -> tuple[Clip, np.random.Generator]:
    """The clip at an index of a batch, and a generator for its augmentation. Raises InputError if a drive is too short.

    It depends on no other clip, but all clips of a batch have the same length, and images that fit into one batch.

    Args:
        seed: of the batch.
        with_gap: with `learn` "last", leave out one of the earlier frames, as published for BEVFormer.
    """
    of_batch, random = np.random.default_rng(seed), np.random.default_rng([*seed, index + 1])
    frames = config.frames
    if frames > 1 and of_batch.random() < config.short_share:
        frames = int(of_batch.integers(1, frames))
    first, shapes = int(of_batch.integers(len(drives))), drives.input_shapes
    alike = range(len(drives)) if shapes is None else _similar_drives(shapes, first)
    drive = int(alike[random.integers(len(alike))]) if index else first
    leave_out = with_gap and config.learn == "last"
    return Clip(drive, draw_frames(drives.open(drive), frames, random, with_gap=leave_out)), random


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
class OwnHeads:
    """The training of a model's heads beyond boxes and maps, registered as "training_heads CLASS".

    Attributes:
        missing: the truth that a frame lacks, in words, and its file; None where nothing is missing.
        truth: of a frame of a drive, at an index, on the CPU. Raises InputError where some of it is missing.
        losses: the weighted scalar losses by name. They take the outputs for B frames, B truths, and of each frame the
            queries that the detection loss matches to boxes, with the indices of these.
    """

    missing: Callable[[Frame, Any], tuple[str, str] | None]
    truth: Callable[[Frame, Sequence, int, Any], Any]
    losses: Callable[[Any, Items[Any], Items[tuple[Tensor, Tensor]], Any], dict[str, Tensor]]


def own_heads(config: ModelConfig) -> OwnHeads | None:
    """The registered training of a model's own heads, if it has some."""
    return next(iter(for_model("training_heads", model_class(config))), None)


@dataclass(frozen=True)
class Targets:
    """The targets of B frames, one of each clip.

    Attributes:
        detection: B, the boxes inside the BEV grid.
        perspective: B, all boxes, for the perspective loss.
        segmentation: B, or None if the model has no segmentation head.
        truths: B, see `OwnHeads`; empty for a model without heads of its own.
    """

    detection: PaddedTargets
    perspective: PaddedTargets
    segmentation: PaddedMasks | None
    truths: tuple[Any, ...] = ()

    def to(self, device: torch.device) -> Targets:
        """A copy on a device."""
        return self._changed(lambda tensor: upload(tensor, device))

    def pinned(self) -> Targets:
        """A copy in memory that a GPU reads by itself."""
        return self._changed(pinned)

    def _changed(self, change: Callable[[Tensor], Tensor]) -> Targets:

        def changed(part: Any) -> Any:
            tensors = {name: x for name, x in vars(part).items() if isinstance(x, Tensor)}
            return replace(part, **{name: change(x) for name, x in tensors.items()})

        masks = None if self.segmentation is None else changed(self.segmentation)
        return Targets(changed(self.detection), changed(self.perspective), masks, self.truths)


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
        inputs = tuple(inputs.to(device) for inputs in self.inputs)
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
        in_bytes: give images as bytes, see `write_bytes`.

    Raises InputError where a frame to train on has no ground truth.
    """

    def load_clip(clip: Clip) -> Batch:
        drive = drives.open(clip.drive)
        loaded = [drive.load(index) for index in clip.frames]
        shown = augmented(loaded, augmentation, random)
        prepared = _prepared(shown, config, in_bytes)
        inputs = _inputs(prepared, config)
        for step in inputs:
            mask_images(step.images, augmentation.grid_mask, random)
        poses = [[one.frame.world_from_ego.matrix @ one.frame.rig.ego_from_bev] for one in prepared]
        world_from_bev = torch.from_numpy(np.array(poses))
        learned = list(zip(prepared, clip.frames, strict=True))[0 if learn_all else -1 :]
        targets = tuple(_targets(one.frame, drive, index, config) for one, index in learned)
        before = Batch(_inputs(_prepared(loaded, config, in_bytes), config), world_from_bev, ()) if plain else None
        return Batch(inputs, world_from_bev, targets, before)

    return joined([load_clip(clip) for clip in clips])


def joined(batches: Items[Batch]) -> Batch:
    """Batches with as many frames and cameras as one batch. Raises InputError where their cameras differ in number."""
    if len(batches) == 1:
        return batches[0]
    inputs = tuple(joined_inputs(steps) for steps in zip(*(batch.inputs for batch in batches), strict=True))
    targets = tuple(_joined_targets(steps) for steps in zip(*(batch.targets for batch in batches), strict=True))
    plain = [batch.plain for batch in batches if batch.plain is not None]
    world_from_bev = torch.cat([batch.world_from_bev for batch in batches], dim=1)
    return Batch(inputs, world_from_bev, targets, joined(plain) if plain else None)


def _joined_targets(parts: Items[Targets]) -> Targets:
    masks = [one.segmentation[frame] for one in parts if one.segmentation for frame in range(len(one.segmentation))]
    return Targets(
        padded([one.detection[frame] for one in parts for frame in range(len(one.detection))]),
        padded([one.perspective[frame] for one in parts for frame in range(len(one.perspective))]),
        padded_masks(masks) if masks else None,
        tuple(truth for one in parts for truth in one.truths),
    )


def ground_truth_boxes(frame: Frame) -> Boxes3D:
    """The ground truth boxes in the bev frame. Raises InputError if the frame has none."""
    if frame.ground_truth is None:
        raise InputError(
            f"frame {frame.stamp.index} of {frame.stamp.scene or 'the drive'} has no ground truth boxes: "
            "training needs ground_truth.json (bevcli convert writes it)"
        )
    return frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev))


def _targets(frame: Frame, drive: Sequence, index: int, config: ModelConfig) -> Targets:
    """index: of the frame in the drive."""
    boxes = ground_truth_boxes(frame)
    detection, perspective = padded([detection_targets(boxes, config)]), padded([box_targets(boxes, config.classes)])
    heads = own_heads(config)
    truths = () if heads is None else (heads.truth(frame, drive, index, config),)
    if "segmentation" not in config.heads:
        return Targets(detection, perspective, None, truths)
    masks = segmentation_targets(boxes, frame.ground_truth_map, config.bev_grid, config.object_classes)
    return Targets(detection, perspective, padded_masks([masks]), truths)


def _prepared(clip: list[Frame], config: ModelConfig, in_bytes: bool) -> list[PreparedFrame]:
    written: dict[str, Any] = {"write": write_bytes, "dtype": np.uint8} if in_bytes else {}
    return [*map(Preprocessor(config, threads=1, **written), clip)]


def _inputs(frames: list[PreparedFrame], config: ModelConfig) -> tuple[ModelInputs, ...]:
    poses = [None, *(one.frame.world_from_ego for one in frames[:-1])]
    return tuple(model_inputs(frame, pose, config) for frame, pose in zip(frames, poses, strict=True))


def _grey(image: ImageConfig) -> NDArray[np.uint8]:
    """(3,) uint8 the pixel value of each channel that is nearest to 0 after normalisation."""
    return np.rint(image.mean).astype(np.uint8)


def write_bytes(pixels_bgr: NDArray[np.uint8], image: ImageConfig, out: NDArray[np.uint8]) -> None:
    """As `write_network_image`, but as uint8 pixel values less the mean grey, modulo 256.

    So padding and missing images, which are 0, become 0. An image that is not resized loses nothing.

    pixels_bgr: (H, W, 3) uint8. out: (3, H', W') uint8, channels last in memory.
    """
    (height, width), (left, top, right, bottom) = pixels_bgr.shape[:2], image.crop_box
    scale = min(image.size[0] / width, image.size[1] / height)
    rows, columns = max(0, min(round(height * scale), bottom) - top), max(0, min(round(width * scale), right) - left)
    if (scale, left, top) == (1, 0, 0):
        pixels = pixels_bgr[:rows, :columns]
        pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)) if image.color_order == "rgb" else pixels
    else:
        values = np.empty((rows, columns, 3), np.float32)
        rounded = replace(image, mean=(-0.5, -0.5, -0.5), std=(1.0, 1.0, 1.0))  # adds 0.5
        write_network_image(pixels_bgr, rounded, values.transpose(2, 0, 1))
        pixels = values.astype(np.uint8)
    lines = out.transpose(1, 2, 0).reshape(out.shape[1], -1)[:rows, : 3 * columns]  # faster than three by three
    np.subtract(pixels.reshape(rows, -1), np.tile(_grey(image), columns), out=lines)


def images_from_bytes(images: Tensor, image: ImageConfig) -> Tensor:
    """The normalised images of `write_bytes` (B, N, 3, H, W), on the same device, channels last."""
    flat = images.flatten(0, 1).contiguous(memory_format=torch.channels_last)
    grey, mean, std = (
        torch.tensor(of_channels, dtype=torch.float32).view(3, 1, 1).to(flat.device, non_blocking=True)
        for of_channels in (_grey(image).tolist(), image.mean, image.std)
    )
    pixels = (flat + grey.to(torch.uint8)).float()
    return pixels.sub_(mean).div_(std).unflatten(0, images.shape[:2])
