"""Where training finds its drives: folders with ground truth, or drives rendered from seeds when they are needed."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Sequence as Items
from pathlib import Path
from typing import Protocol

from bevcli.frame import Sequence
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.sequences.open import open_sequence
from bevcli.synth.assets.catalog import Assets
from bevcli.synth.drive import RenderedDrive
from bevcli.synth.export import export_drive
from bevcli.synth.render.bev_map import MapWindow
from bevcli.synth.rig import nuscenes_like_rig

FIRST_HELD_OUT_SEED = 1_000_000  # drives from here on are for evaluation only
FRAMES_A_DRIVE = 20


class Drives(Protocol):
    """Some drives; threads may open them side by side."""

    def __len__(self) -> int: ...

    def open(self, place: int) -> Sequence:
        """The drive at a place, 0 to len - 1, at the model's rate. Raises InputError."""
        ...


class FolderDrives:
    """Sequence folders (or nuScenes roots), opened when they are first asked for and kept open by each thread."""

    def __init__(self, folders: Items[Path], rate_hz: float) -> None:
        self._folders = tuple(folders)
        self._rate_hz = rate_hz
        self._of_thread = threading.local()  # a sequence is read by one thread

    def __len__(self) -> int:
        return len(self._folders)

    def open(self, place: int) -> Sequence:
        """The drive at a place, thinned to the model's rate."""
        opened: dict[int, Sequence] = vars(self._of_thread).setdefault("opened", {})
        if place not in opened:
            opened[place] = open_sequence(self._folders[place], rate_hz=self._rate_hz)
        return opened[place]


class RenderedDrives:
    """Rendered drives of some seeds, in the model's image size, kept as sequence folders under `cache`/WxH."""

    def __init__(self, seeds: Items[int], cache: Path, config: BEVFormerConfig) -> None:
        width, height = config.image.size
        self._folders = [cache / f"{width}x{height}" / f"{seed:06d}" for seed in seeds]
        self._seeds = tuple(seeds)
        self._config = config
        self._rendering = threading.Lock()
        self._assets: Assets | None = None
        self._drives = FolderDrives(self._folders, config.rate_hz)

    def __len__(self) -> int:
        return len(self._seeds)

    def open(self, place: int) -> Sequence:
        """The drive at a place; rendered (some seconds) when it is not in the cache."""
        folder = self._folders[place]
        with self._rendering:
            if not folder.exists():
                self._render(self._seeds[place], folder)
        return self._drives.open(place)

    def _render(self, seed: int, folder: Path) -> None:
        """Under another name until it is whole, so that a kill leaves no half drive behind."""
        self._assets = self._assets or Assets.build()
        width, height = self._config.image.size
        grid = self._config.bev_grid
        reach = max(abs(end) for end in (*grid.x_range_m, *grid.y_range_m))
        drive = RenderedDrive(
            seed,
            FRAMES_A_DRIVE,
            self._config.rate_hz,
            nuscenes_like_rig(width, height),
            assets=self._assets,
            map_window=MapWindow(half_extent_m=reach),
        )
        unfinished = folder.with_suffix(f".unfinished-{os.getpid()}")
        shutil.rmtree(unfinished, ignore_errors=True)
        export_drive(drive, unfinished)
        try:
            os.replace(unfinished, folder)
        except OSError:
            if not folder.exists():
                raise
            shutil.rmtree(unfinished)  # another process was faster


def part_of(drives: Drives, start: int, end: int) -> Drives:
    """The drives from place `start` to before `end`."""
    return _Part(drives, start, end)


class _Part:
    def __init__(self, drives: Drives, start: int, end: int) -> None:
        self._drives, self._places = drives, range(start, end)

    def __len__(self) -> int:
        return len(self._places)

    def open(self, place: int) -> Sequence:
        return self._drives.open(self._places[place])
