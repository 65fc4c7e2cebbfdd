"""Batches of clips, made ahead of the training: by a thread, or by processes that share no lock with it.

Each process makes one clip at a time, so that all of them work for the first batch. A clip from a process comes through
a file in memory or, where that is small, in the folder for temporary files.
"""

import mmap
import os
import pickle
import shutil
import signal
import tempfile
import threading
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from io import BytesIO
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.errors import OutputError
from bevcli.inference.pipeline import read_ahead
from bevcli.model.config import ModelConfig
from bevcli.workshop.synth.drives import Drives
from bevcli.workshop.training.augmentation import AugmentationConfig
from bevcli.workshop.training.samples import Batch, ClipConfig, draw_clip, joined, load_batch

MEMORY_FOLDER = Path("/dev/shm")  # files in memory, on Linux
FREE_CLIPS = 64  # for so many, that folder has to have space
ALIGNMENT = 64  # bytes


@dataclass(frozen=True)
class BatchMaker:
    """Makes any batch of a training; it can be pickled.

    Attributes:
        drives: to draw clips from.
        model: the configuration of the model.
        clips: how clips are drawn.
        augmentation: of their images.
        seed: of the training.
        rank: of this process among those that train together.
        with_gap: leave out a frame of the clips, see `draw_clips`.
        plain: give the clips before augmentation too.
        in_bytes: give images as bytes, see `write_bytes`.
    """

    drives: Drives
    model: ModelConfig
    clips: ClipConfig
    augmentation: AugmentationConfig
    seed: int
    rank: int
    with_gap: bool
    plain: bool
    in_bytes: bool

    def __call__(self, step: int, turn: int) -> Batch:
        """The batch of a step (0 to `clips.in_turn` - 1 are its turns). It depends on no other batch."""
        return joined([self.clip(step, turn, index) for index in range(self.clips.batch)])

    def clip(self, step: int, turn: int, index: int) -> Batch:
        """The clip at an index (0 to `clips.batch` - 1) of that batch. It depends on no other clip."""
        seed = [self.seed, step, self.rank, turn]
        clip, random = draw_clip(self.drives, self.clips, seed, index, with_gap=self.with_gap)
        return load_batch(
            self.drives, [clip], self.model, self.augmentation, random,
            learn_all=self.clips.learn == "all", plain=self.plain, in_bytes=self.in_bytes,
        )  # fmt: skip


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
            packed = [pool.submit(_make_packed, (*turn, index)) for index in range(count)]
            clips = [clip.result().unpack() for clip in packed]
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
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


@dataclass(frozen=True)
class _Packed:
    """A clip in a file.

    Attributes:
        path: of the file, which holds the contents of all arrays.
        ends: where each begins and ends in the file.
        rest: the clip without them, pickled.
    """

    path: Path
    ends: tuple[tuple[int, int], ...]
    rest: bytes

    def unpack(self) -> Batch:
        """The clip; its tensors are views of the file, which loses its name."""
        with open(self.path, "r+b") as file:
            contents = memoryview(mmap.mmap(file.fileno(), 0))
        self.path.unlink()
        batch: Batch = pickle.loads(self.rest, buffers=[contents[start:end] for start, end in self.ends])
        return batch


def _make_packed(clip: tuple[int, int, int]) -> _Packed:
    """clip: step, turn, and index in the batch."""
    maker, folders = _loader
    arrays: list[pickle.PickleBuffer] = []
    rest = BytesIO()
    _Pickler(rest, protocol=5, buffer_callback=arrays.append).dump(maker.clip(*clip))
    needed = FREE_CLIPS * sum(array.raw().nbytes for array in arrays)
    roomy = (folder for folder in folders if shutil.disk_usage(folder).free >= needed)
    path, ends = next(roomy, folders[-1]) / "-".join(map(str, clip)), []
    with open(path, "wb") as file:
        for array in arrays:
            start = file.tell()
            file.write(array.raw())
            ends.append((start, file.tell()))
            file.write(bytes(-file.tell() % ALIGNMENT))
        file.write(bytes(ALIGNMENT))  # an empty file cannot be mapped
    return _Packed(path, tuple(ends), rest.getvalue())


class _Pickler(pickle.Pickler):
    """Pickles a tensor as an array, whose contents can be kept apart."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            strides = value.stride()
            order = sorted(range(value.ndim), key=lambda axis: -strides[axis])  # as it lies in memory
            return _from_array, (value.permute(order).contiguous().numpy(), order)
        return NotImplemented


def _from_array(array: NDArray[Any], order: list[int]) -> Tensor:
    return torch.from_numpy(array).permute(np.argsort(order).tolist())


@contextmanager
def blocked_interrupts() -> Iterator[None]:
    """Processes that start in the block never see Ctrl-C: it reaches their parent, which ends them."""
    resource_tracker.ensure_running()  # it would be started with the first process, and unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
