"""Training samples: clips drawn from drives, their frames as network inputs and targets, and batches made ahead.

As in the paper, the last frame of a clip is trained on; the others are its history. Batches are made by a thread, or by
processes that share no lock with the training. Each process makes one clip at a time, so that all of them work for the
first batch. A clip from a process comes through a file in memory or, where that is small, in the folder for temporary
files.
"""

import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from itertools import zip_longest
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from bevcli.errors import InputError, OutputError
from bevcli.frame import Drive, Frame
from bevcli.inference.pipeline import read_ahead
from bevcli.inference.preprocess import Preprocessor, write_network_image
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.step import ModelInputs, PreparedFrame, model_inputs
from bevcli.model.upload import pinned, tensors_in, upload
from bevcli.parsing.documents import Count, Share
from bevcli.printing import counted
from bevcli.sequences.open import scenes_of
from bevcli.workshop.synth.drives import Drives, FrameMemory, InputShape
from bevcli.workshop.training.augmentation import (
    UNDISTORTED,
    AugmentationConfig,
    augmented,
    distorted,
    distorted_images,
    mask_images,
)
from bevcli.workshop.training.targets import Targets, frame_targets, joined_targets
from bevcli.writing import output_errors

_CHOICE = 8  # drives among which the other clips of a batch are drawn, at least

MEMORY_FOLDER = Path("/dev/shm")  # files in memory, on Linux
FREE_CLIPS = 64  # for so many, that folder has to have space


@dataclass(frozen=True)
class ClipConfig:
    """The [training.clips] table."""

    frames: Count = 3  # frames of a clip. The paper's base model uses 4, tiny and small use 3; 1 trains without history
    batch: Count = 4  # clips of a batch
    short_share: Share = 0.1  # of the batches, with shorter clips, because each scene starts without history
    learn: Literal["last", "all"] = "last"  # frames of a clip to train on; "last" as published
    in_turn: Count = 1  # with "all", batches a step, whose updates alternate: successive ones see other streets

    def __post_init__(self) -> None:
        if self.in_turn > 1 and self.learn != "all":
            raise ValueError('in_turn must be 1 unless learn is "all"')

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
    """Some frames of one drive."""

    drive: int  # index of the drive
    frames: tuple[int, ...]  # indices of the frames in the drive, ascending


def draw_clip(
    drives: Drives, config: ClipConfig, seed: Sequence[int], index: int, *, with_gap: bool = True
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


def draw_frames(sequence: Drive, count: int, random: np.random.Generator, *, with_gap: bool = True) -> tuple[int, ...]:
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
class Batch:
    """B clips of the same length."""

    inputs: tuple[ModelInputs, ...]  # one a frame of the clips, each for B clips; images may be in bytes
    world_from_bev: Tensor  # (frames, B, 4, 4) float64, the poses of the bev frames, metres
    targets: tuple[Targets, ...]  # of the last frames; fewer than inputs if the first ones are history only
    plain: "Batch | None" = None  # the same clips before augmentation, for a teacher; None without one
    distortions: tuple[Tensor, ...] = ()  # (B, N, 4) float32, of images in bytes; () where they are distorted
    missing: tuple[str, ...] = ()  # images that cannot be read, for the user; only of a batch that was just made

    def to(self, device: torch.device) -> "Batch":
        """A copy on a device. Projections and poses stay on the CPU, which reads them without waiting for a GPU."""
        inputs = tuple(inputs.to(device) for inputs in self.inputs)
        plain = None if self.plain is None else self.plain.to(device)
        targets = tuple(targets.to(device) for targets in self.targets)
        return Batch(inputs, self.world_from_bev, targets, plain, tuple(upload(x, device) for x in self.distortions))

    def pinned(self) -> "Batch":
        """A copy whose images and targets are in memory that a GPU reads by itself."""
        inputs = tuple(replace(step, images=pinned(step.images)) for step in self.inputs)
        plain = None if self.plain is None else self.plain.pinned()
        return replace(self, inputs=inputs, targets=tuple(targets.pinned() for targets in self.targets), plain=plain)

    def normalised(self, image: ImageConfig) -> "Batch":
        """The batch with its images distorted and normalised, where they are in bytes."""
        if self.inputs[0].images.dtype != torch.uint8:
            return self
        inputs = tuple(
            replace(step, images=images_from_bytes(step.images, image, distortions))
            for step, distortions in zip_longest(self.inputs, self.distortions)
        )
        plain = None if self.plain is None else self.plain.normalised(image)
        return replace(self, inputs=inputs, plain=plain, distortions=())


def joined(batches: Sequence[Batch]) -> Batch:
    """Batches with as many frames and cameras as one batch. Raises InputError where their cameras differ in number."""
    if len(batches) == 1:
        return batches[0]
    inputs = tuple(joined_inputs(steps) for steps in zip(*(batch.inputs for batch in batches), strict=True))
    targets = tuple(joined_targets(steps) for steps in zip(*(batch.targets for batch in batches), strict=True))
    plain = [batch.plain for batch in batches if batch.plain is not None]
    world_from_bev = torch.cat([batch.world_from_bev for batch in batches], dim=1)
    distortions = tuple(map(torch.cat, zip(*(batch.distortions for batch in batches), strict=True)))
    missing = tuple(text for batch in batches for text in batch.missing)
    return Batch(inputs, world_from_bev, targets, joined(plain) if plain else None, distortions, missing)


def joined_inputs(parts: Sequence[ModelInputs]) -> ModelInputs:
    """The inputs of several batches as one batch, without slopes that were expected.

    Raises InputError where they have different numbers of cameras.
    """
    counts = sorted({part.has_image.shape[1] for part in parts})
    if len(counts) > 1:
        raise InputError(
            f"{counts[0]} and {counts[-1]} cameras cannot go into one batch: use sequences with the same number of "
            "cameras, or batches of 1"
        )
    names = [field.name for field in fields(ModelInputs) if field.name != "expected_slopes"]
    tensors = {name: [getattr(part, name) for part in parts] for name in names}
    images, indices = tensors.pop("images"), tensors.pop("camera_index")
    same = all(torch.equal(index, indices[0]) for index in indices)
    rows = [index.expand(len(part.has_image), -1) for index, part in zip(indices, parts, strict=True)]
    index = indices[0] if same and indices[0].ndim == 1 else torch.cat(rows)
    joined: dict[str, Any] = {name: torch.cat(values) for name, values in tensors.items()}
    return ModelInputs(images=_together(images), camera_index=index, **joined)


def _together(images: list[Tensor]) -> Tensor:
    """Images (B, N, 3, H, W) of several batches, padded with zeros at right and bottom to the largest of them.

    They are joined channels last, as they lie in memory.
    """
    height, width = (max(batch.shape[axis] for batch in images) for axis in (-2, -1))

    def padded(batch: Tensor) -> Tensor:
        missing = (0, width - batch.shape[-1], 0, height - batch.shape[-2])
        return (F.pad(batch, missing) if any(missing) else batch).movedim(2, -1)

    return torch.cat([padded(batch) for batch in images]).movedim(-1, 2)


def _prepared(clip: list[Frame], config: ModelConfig, in_bytes: bool) -> list[PreparedFrame]:
    written: dict[str, Any] = {"write": write_bytes, "dtype": np.uint8} if in_bytes else {}
    return [*map(Preprocessor(config, threads=1, **written), clip)]


def _inputs(frames: list[PreparedFrame], config: ModelConfig) -> tuple[ModelInputs, ...]:
    poses = [None, *(prepared.frame.world_from_ego for prepared in frames[:-1])]
    return tuple(model_inputs(prepared, pose, config) for prepared, pose in zip(frames, poses, strict=True))


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
    np.subtract(pixels.reshape(rows, -1), np.tile(np.rint(image.mean).astype(np.uint8), columns), out=lines)


def images_from_bytes(images: Tensor, image: ImageConfig, distortions: Tensor | None = None) -> Tensor:
    """The normalised images of `write_bytes` (B, N, 3, H, W), on the same device, channels last.

    distortions: (B, N, 4), photometric. What is 0 in all channels (padding, missing images, masks) stays 0.
    """
    flat = images.flatten(0, 1).contiguous(memory_format=torch.channels_last)
    of_channels = torch.tensor([np.rint(image.mean).tolist(), image.mean, image.std], dtype=torch.float32)
    grey, mean, std = upload(of_channels, flat.device)[..., None, None].unbind(0)  # (3, 1, 1) each
    pixels = (flat + grey.to(torch.uint8)).float()
    if distortions is not None:
        changed = distorted_images(pixels, distortions.flatten(0, 1), image.color_order)
        pixels = changed.where(flat.ne(0).any(dim=1, keepdim=True), pixels)
    return pixels.sub_(mean).div_(std).unflatten(0, images.shape[:2])


@dataclass(frozen=True)
class BatchMaker:
    """Makes any batch of a training; it can be pickled."""

    drives: Drives  # to draw clips from
    model: ModelConfig  # the configuration of the model
    clips: ClipConfig  # how clips are drawn
    augmentation: AugmentationConfig  # of their images
    seed: int  # of the training
    rank: int  # of this process among those that train together
    with_gap: bool  # leave out a frame of the clips, see `draw_clips`
    plain: bool  # give the clips before augmentation too
    in_bytes: bool  # give images as bytes, see `write_bytes`
    memory: FrameMemory = field(default_factory=lambda: FrameMemory(0))  # of the drives' frames

    def __call__(self, step: int, turn: int) -> Batch:
        """The batch of a step (0 to `clips.in_turn` - 1 are its turns). It depends on no other batch."""
        return joined([self.clip(step, turn, index) for index in range(self.clips.batch)])

    def clip(self, step: int, turn: int, index: int) -> Batch:
        """The clip at an index (0 to `clips.batch` - 1) of that batch. It depends on no other clip."""
        seed = [self.seed, step, self.rank, turn]
        clip, random = draw_clip(self.drives, self.clips, seed, index, with_gap=self.with_gap)
        return self.load(clip, random)

    def load(self, clip: Clip, random: np.random.Generator) -> Batch:
        """The frames of a clip, read, augmented and preprocessed; raises InputError where one has no ground truth."""
        config, augmentation, in_bytes = self.model, self.augmentation, self.in_bytes
        drive = self.drives.open(clip.drive)
        loaded = [self.memory.load(drive, clip.drive, index) for index in clip.frames]
        shown, drawn = augmented(loaded, augmentation, random)
        prepared = _prepared(shown if in_bytes else [*map(distorted, shown, drawn)], config, in_bytes)
        inputs = _inputs(prepared, config)
        for step in inputs:
            mask_images(step.images, augmentation.grid_mask, random)
        poses = [[x.frame.world_from_ego.matrix @ x.frame.rig.ego_from_bev] for x in prepared]
        world_from_bev = torch.from_numpy(np.array(poses))
        learned = prepared if self.clips.learn == "all" else prepared[-1:]
        targets = tuple(frame_targets(x.frame, config) for x in learned)
        plain = Batch(_inputs(_prepared(loaded, config, in_bytes), config), world_from_bev, ()) if self.plain else None
        distortions = tuple(
            torch.tensor([[changes.get(name, UNDISTORTED) for name in x.assignment.cameras]])  # (1, N, 4)
            for x, changes in zip(prepared, drawn, strict=True)
            if in_bytes and augmentation.photometric
        )
        lacking = [(x.stamp.index, name, why) for x in loaded for name, why in x.dropped.items()]
        missing = tuple(f"{drive.name}, frame {index}, {name}: {why}" for index, name, why in lacking)
        return Batch(inputs, world_from_bev, targets, plain, distortions, missing)


def loaded_batches(
    maker: BatchMaker, turns: Iterable[tuple[int, int]], loaders: int, *, pin: bool = False
) -> Generator[Batch]:
    """The batches of these turns (step, turn), in order, made ahead by `loaders`: one thread, or several processes.

    pin: copy them to memory that a GPU reads by itself. Close the generator to end the processes.
    Raises what making a batch raises, and OutputError where a process ends early.
    """
    count = maker.clips.batch
    depth = max(maker.clips.in_turn, -(-2 * loaders // count))  # two clips a process are waiting
    if loaders == 1:
        yield from read_ahead(lambda turn: maker(*turn), turns, depth)
        return
    context = get_context("spawn")
    line_end, line = context.Pipe(duplex=False)
    parents = [str(MEMORY_FOLDER)] * os.access(MEMORY_FOLDER, os.W_OK) + [tempfile.gettempdir()]
    folders = tuple(Path(tempfile.mkdtemp(prefix="bevcli-batches-", dir=parent)) for parent in parents)
    pool = ProcessPoolExecutor(loaders, context, _start_loader, (maker, line_end, folders))

    def load(turn: tuple[int, int]) -> Batch:
        try:
            files = [pool.submit(_make_file, (*turn, index)) for index in range(count)]
            clips = [_read_file(file.result()) for file in files]
        except BrokenProcessPool:
            raise OutputError(
                "a process that makes batches ended early (out of memory?): use fewer `loaders`"
            ) from None
        batch = joined(clips)
        return batch.pinned() if pin else batch

    try:
        with blocked_interrupts():
            for _ in range(loaders):  # starts a process each
                pool.submit(int)
        with closing(read_ahead(load, turns, depth, threads=depth)) as batches:  # threads that only wait
            yield from batches
    finally:
        line.close()  # the processes end at once
        pool.shutdown(cancel_futures=True)
        _remove(folders)


_loader: tuple[BatchMaker, tuple[Path, ...]]  # of a process that makes clips


def _remove(folders: Iterable[Path]) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


def _start_loader(maker: BatchMaker, line: Connection, folders: tuple[Path, ...]) -> None:
    """Prepare a process, which ends as soon as the other end of the line is closed, or the process that holds it."""
    global _loader
    _loader = maker, folders
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the other end of the line is closed in any case

    def end_with_parent() -> None:
        line.poll(None)
        _remove(folders)
        os._exit(0)

    threading.Thread(target=end_with_parent, daemon=True).start()
    torch.serialization.set_crc32_options(False)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _make_file(clip: tuple[int, int, int]) -> Path:
    """Write a clip (step, turn, and index in the batch) to a file. For its checksums there is no use."""
    maker, folders = _loader
    made, name = maker.clip(*clip), "-".join(map(str, clip))
    needed = FREE_CLIPS * sum(tensor.nbytes for _, tensor in tensors_in(made))
    path = next((folder for folder in folders if shutil.disk_usage(folder).free >= needed), folders[-1]) / name
    with output_errors(path):
        save(made, path)
    return path


def save(contents: object, path: Path) -> None:
    """`torch.save`; raises OSError where the disk is full."""
    try:
        torch.save(contents, path)
    except RuntimeError as error:
        raise OSError(f"is the disk full? {error}") from error


def _read_file(path: Path) -> Batch:
    """The clip in a file, which loses its name. Its tensors are views of it, but for Windows, which keeps names."""
    clip: Batch = torch.load(path, mmap=sys.platform != "win32", weights_only=False)
    path.unlink()
    return clip


@contextmanager
def blocked_interrupts() -> Iterator[None]:
    """Processes that start in the block never see Ctrl-C: it reaches their parent, which ends them."""
    if sys.platform == "win32":  # it cannot block signals
        yield
        return
    resource_tracker.ensure_running()  # it would be started with the first process, and unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
