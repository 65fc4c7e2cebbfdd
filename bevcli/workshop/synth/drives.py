"""Drives with ground truth, for training, validation and stress tests: sequence folders, or rendered from seeds."""

import hashlib
import os
import shutil
import threading
from collections.abc import Mapping, Sequence as Items
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.inference.preprocess import image_for_rig, network_scale, rig_enlargement
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import SequenceOptions
from bevcli.workshop.synth.assets.catalog import Assets
from bevcli.workshop.synth.drive import RenderedDrive
from bevcli.workshop.synth.export import export_drive
from bevcli.workshop.synth.rig import DrawnRig, RigDistribution, draw_rig, nuscenes_like_rig

FIRST_HELD_OUT_SEED = 1_000_000  # drives from this seed on are for evaluation only
FRAMES_PER_DRIVE = 20
InputShape = tuple[int, int, int]  # cameras, height, width


class Drives(Protocol):
    """A list of drives. Several threads may open them at the same time.

    Attributes:
        input_shapes: of each drive, the number of cameras, and height and width of the network's input in pixels; None
            where any of them may share a batch.
    """

    @property
    def input_shapes(self) -> tuple[InputShape, ...] | None: ...

    def __len__(self) -> int: ...

    def open(self, index: int) -> Sequence:
        """The drive at an index (0 to len - 1), at the model's frame rate. Raises InputError."""
        ...


class FolderDrives:
    """Sequence folders (or nuScenes roots). Each thread opens a drive once and keeps it open."""

    input_shapes: tuple[InputShape, ...] | None = None

    def __init__(self, folders: Items[Path], config: ModelConfig, class_map: Mapping[str, str] | None = None) -> None:
        self._folders = tuple(folders)
        self._options = SequenceOptions(class_map or {}, rate_hz=config.rate_hz, classes=config.classes)
        self._of_thread = threading.local()  # a Sequence must be read from one thread

    def __getstate__(self) -> dict[str, Any]:
        """Without what belongs to this process, so that other processes can open the drives."""
        return {**vars(self), "_of_thread": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _of_thread=threading.local())

    def __len__(self) -> int:
        return len(self._folders)

    def open(self, index: int) -> Sequence:
        """The drive at an index, thinned to the model's frame rate. Raises InputError."""
        opened: dict[int, Sequence] = vars(self._of_thread).setdefault("opened", {})
        if index not in opened:
            opened[index] = open_sequence(self._folders[index], self._options)
        return opened[index]


class RenderedDrives(FolderDrives):
    """Rendered drives in the model's image size, kept as sequence folders `cache/WIDTHxHEIGHT/SEED`.

    Drives with other cameras than the default ones are kept in `cache/WIDTHxHEIGHT-RIG/SEED`.

    Args:
        rig: the cameras of all drives, scaled to the model's image size, or the distribution of the drives' rigs.
            Default: `nuscenes_like_rig`.
    """

    def __init__(
        self,
        seeds: Items[int],
        cache: Path,
        config: ModelConfig,
        rig: CameraRig | RigDistribution | None = None,
        class_map: Mapping[str, str] | None = None,
    ) -> None:
        image, (width, height) = config.image, config.image.size
        name = f"{width}x{height}"
        if isinstance(rig, RigDistribution):
            self._rigs = [_enlarged(draw_rig(rig, seed, image.size), image) for seed in seeds]
            self.input_shapes = tuple(_input_shape(drawn.rig, image) for drawn in self._rigs)
            name += f"-rigs-{rig.digest}"
            name += "" if image.focal_px is None else f"-{image.focal_px:g}px-{image.max_pixels}"
        else:
            found = nuscenes_like_rig(width, height) if rig is None else _fitting(rig, image)
            self._rigs = [DrawnRig(found)] * len(seeds)
            name += "" if rig is None else f"-rig-{_digest(found)}"
        super().__init__([cache / name / f"{seed:06d}" for seed in seeds], config, class_map)
        self._seeds, self._config = tuple(seeds), config
        self._rendering = threading.Lock()
        self._assets: Assets | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_rendering": None, "_assets": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "_rendering": threading.Lock()})

    def open(self, index: int) -> Sequence:
        """The drive at an index. It is rendered first, which takes seconds, if the cache does not hold it."""
        folder = self._folders[index]
        with self._rendering:
            if not folder.exists():
                self._render(self._seeds[index], self._rigs[index], folder)
        return super().open(index)

    def _render(self, seed: int, drawn: DrawnRig, folder: Path) -> None:
        """Writes to a temporary folder and renames it, so that an interrupted process leaves no partial drive."""
        self._assets = self._assets or Assets.build()
        grid = self._config.bev_grid
        half_extent = max(abs(end) for end in (*grid.x_range_m, *grid.y_range_m))
        drive = RenderedDrive(
            seed, FRAMES_PER_DRIVE, self._config.rate_hz, drawn, assets=self._assets,
            supersampling=drawn.supersampling, map_half_extent_m=half_extent,
        )  # fmt: skip
        unfinished = folder.with_suffix(f".unfinished-{os.getpid()}")
        shutil.rmtree(unfinished, ignore_errors=True)
        export_drive(drive, unfinished, quality=drawn.jpeg_quality)
        try:
            os.replace(unfinished, folder)
        except OSError:
            if not folder.exists():
                raise
            shutil.rmtree(unfinished)  # another process has rendered the same drive meanwhile


def _fitting(rig: CameraRig, image: ImageConfig) -> CameraRig:
    """The rig with each camera's images in the size in which the network sees them."""
    sized = image_for_rig(rig, image)
    return replace(rig, cameras=tuple(camera.scaled(network_scale(camera, sized)) for camera in rig.cameras))


def _enlarged(drawn: DrawnRig, image: ImageConfig) -> DrawnRig:
    """A rig drawn for images of `image.size`, with images as much larger as the network sees them."""
    factor = rig_enlargement(drawn.rig, image)
    cameras = tuple(camera.scaled(factor) for camera in drawn.rig.cameras)
    return replace(drawn, rig=replace(drawn.rig, cameras=cameras))


def _input_shape(rig: CameraRig, image: ImageConfig) -> InputShape:
    width, height = image_for_rig(rig, image).padded_size
    return len(rig.cameras), height, width


def _digest(rig: CameraRig) -> str:
    """Eight hexadecimal digits that differ between rigs."""
    parts = [
        (c.name, c.width, c.height, c.intrinsics.tolist(), c.ego_from_camera.tolist(), c.distortion)
        for c in rig.cameras
    ]
    return hashlib.sha256(repr((parts, rig.ego_from_bev.tolist())).encode()).hexdigest()[:8]


class _Subset:
    """Some of the drives."""

    def __init__(self, drives: Drives, indices: range) -> None:
        self._drives, self._indices = drives, indices
        shapes = drives.input_shapes
        self.input_shapes = None if shapes is None else tuple(shapes[index] for index in indices)

    def __len__(self) -> int:
        return len(self._indices)

    def open(self, index: int) -> Sequence:
        return self._drives.open(self._indices[index])


def open_drives(
    folders: Items[Path],
    seeds: Items[int] | None,
    cache: Path,
    config: ModelConfig,
    rig: CameraRig | RigDistribution | None = None,
    class_map: Mapping[str, str] | None = None,
) -> Drives:
    """The drives in folders, or those rendered from seeds.

    Args:
        folders: sequence folders with ground truth; empty if seeds are given.
        seeds: of rendered drives; None if folders are given.
        cache: the folder that keeps rendered drives.
        rig: of rendered drives, or the distribution of their rigs; None for the default rig.
        class_map: names of the ground truth -> classes of the model.

    Raises:
        InputError: both or neither are given.
    """
    if bool(folders) == (seeds is not None):
        raise InputError("choose the drives: give either `data=DIR` (repeatable), `rendered=SEEDS` or `split=FILE`")
    if seeds is None:
        return FolderDrives(folders, config, class_map)
    return RenderedDrives(seeds, cache, config, rig, class_map)


def check_training_seeds(seeds: Items[int]) -> None:
    """Raises InputError if a seed is reserved for evaluation."""
    if max(seeds, default=0) >= FIRST_HELD_OUT_SEED:
        raise InputError(
            f"`rendered`: seed {max(seeds)} is reserved for evaluation; train on seeds below {FIRST_HELD_OUT_SEED}"
        )


def split_drives(drives: Drives, held_out: int) -> tuple[Drives, Drives]:
    """The drives to train on, and those to evaluate on: the last `held_out`, or all of them if that is 0.

    Raises:
        InputError: no drive is left to train on.
    """
    count = len(drives)
    if count <= held_out:
        raise InputError(
            f"{count} drives are too few with {held_out} of them held out for evaluation: give more, "
            "or set held_out = 0 in [training] to evaluate on the training drives"
        )
    first_held_out = count - held_out
    evaluated = range(first_held_out if held_out else 0, count)
    return _Subset(drives, range(first_held_out)), _Subset(drives, evaluated)


def count_frames(drives: Drives) -> int:
    """The number of frames of all drives. Opens each of them."""
    return sum(len(drives.open(index).stamps) for index in range(len(drives)))
