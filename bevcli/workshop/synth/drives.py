"""Drives with ground truth, for training, validation and stress tests: sequence folders, or rendered from seeds.

A split says which drives are trained on and which are scored: a file states them, or the last drives are held out.
"""

import glob
import hashlib
import json
import os
import shutil
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from bevcli.errors import InputError
from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.geometry.cameras import CameraRig
from bevcli.inference.preprocess import image_for_rig, network_scale, rig_enlargement
from bevcli.model.config import ModelConfig
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import read_text
from bevcli.sequences.open import open_sequence, open_steps
from bevcli.sequences.options import InputOptions
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.drive import RenderedDrive, export_drive
from bevcli.workshop.synth.material import MaterialFolder
from bevcli.workshop.synth.rig import DrawnRig, RigDistribution, draw_rig, nuscenes_like_rig
from bevcli.writing import UNFINISHED, remove_abandoned, write_whole

FIRST_HELD_OUT_SEED = 1_000_000  # drives from this seed on are for evaluation only
FRAMES_PER_DRIVE = 20
InputShape = tuple[int, int, int]  # number of cameras; height and width, pixels


class Drives(Protocol):
    """A list of drives. Several threads may open them at the same time."""

    @property
    def input_shapes(self) -> tuple[InputShape, ...] | None:
        """Of each drive the shape of the network's input; None where any of them may share a batch."""
        ...

    def __len__(self) -> int: ...

    def open(self, index: int) -> Drive:
        """The drive at an index (0 to len - 1), at the model's frame rate. Raises InputError."""
        ...


class FolderDrives:
    """Sequence folders (or nuScenes roots). Each thread opens a drive once and keeps it open."""

    input_shapes: tuple[InputShape, ...] | None = None

    def __init__(
        self, folders: Sequence[Path], config: ModelConfig, class_map: Mapping[str, str] | None = None
    ) -> None:
        self.folders = tuple(folders)
        self._options = InputOptions(class_map or {}, rate_hz=config.rate_hz, classes=config.classes)
        self._of_thread = threading.local()  # a Drive must be read from one thread

    def measure_motion(self) -> Iterator[tuple[int, int]]:
        """Open every drive with the motion that its images show: the number of steps that are measured, and of all."""
        self._options = replace(self._options, odometry=True)
        for index in range(len(self)):
            for step in open_steps(self._folder(index), self._options):
                if isinstance(step, tuple):
                    yield step
                else:
                    self._opened[index] = step

    def __getstate__(self) -> dict[str, Any]:
        """Without what belongs to this process, so that other processes can open the drives."""
        return {**vars(self), "_of_thread": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _of_thread=threading.local())

    def __len__(self) -> int:
        return len(self.folders)

    def open(self, index: int) -> Drive:
        """The drive at an index, thinned to the model's frame rate. Raises InputError."""
        if index not in self._opened:
            self._opened[index] = open_sequence(self._folder(index), self._options)
        return self._opened[index]

    @property
    def _opened(self) -> dict[int, Drive]:
        """The drives that this thread has opened."""
        opened: dict[int, Drive] = vars(self._of_thread).setdefault("opened", {})
        return opened

    def _folder(self, index: int) -> Path:
        """The folder of a drive, which is there."""
        return self.folders[index]


class RenderedDrives(FolderDrives):
    """Rendered drives in the model's image size, kept as sequence folders `cache/WIDTHxHEIGHT/SEED`.

    Drives with other cameras than the default ones are kept in `cache/WIDTHxHEIGHT-RIG/SEED`.

    Args:
        rig: the cameras of all drives, scaled to the model's image size, or the distribution of the drives' rigs.
            Default: `nuscenes_like_rig`.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        cache: Path,
        config: ModelConfig,
        rig: CameraRig | RigDistribution | None = None,
        class_map: Mapping[str, str] | None = None,
    ) -> None:
        image, (width, height) = config.image, config.image.size
        name = f"{width}x{height}"
        if isinstance(rig, RigDistribution):
            if rig.material:
                MaterialFolder.read(rig.material)  # a wrong file is an error before the training begins
            self._rigs = []
            for drawn in (draw_rig(rig, seed, image.size) for seed in seeds):
                factor = rig_enlargement(drawn.rig, image)  # images as much larger as the network sees them
                cameras = tuple(camera.scaled(factor) for camera in drawn.rig.cameras)
                self._rigs.append(replace(drawn, rig=replace(drawn.rig, cameras=cameras)))
            sizes = [image_for_rig(drawn.rig, image).padded_size for drawn in self._rigs]
            counts = [len(drawn.rig.cameras) for drawn in self._rigs]
            self.input_shapes = tuple((count, h, w) for count, (w, h) in zip(counts, sizes, strict=True))
            name += f"-rigs-{rig.digest}"
            name += "" if image.focal_px is None else f"-{image.focal_px:g}px-{image.max_pixels}"
        else:
            fitting = nuscenes_like_rig(width, height)
            if rig is not None:  # each camera's images in the size in which the network sees them
                sized = image_for_rig(rig, image)
                cameras = tuple(camera.scaled(network_scale(camera, sized)) for camera in rig.cameras)
                fitting = replace(rig, cameras=cameras)
            self._rigs = [DrawnRig(fitting)] * len(seeds)
            facts = [
                (c.name, c.width, c.height, c.intrinsics.tolist(), c.ego_from_camera.tolist(), c.distortion)
                for c in fitting.cameras
            ]
            digest = hashlib.sha256(repr((facts, fitting.ego_from_bev.tolist())).encode()).hexdigest()[:8]
            name += "" if rig is None else f"-rig-{digest}"
        super().__init__([cache / name / f"{seed:06d}" for seed in seeds], config, class_map)
        self._seeds, self._config = tuple(seeds), config
        self._rendering = threading.Lock()
        self._assets: Assets | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_rendering": None, "_assets": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "_rendering": threading.Lock()})

    def _folder(self, index: int) -> Path:
        """The folder of a drive. It is rendered first, which takes seconds, if the cache does not hold it."""
        folder = self.folders[index]
        with self._rendering:
            if not folder.exists():
                self._render(self._seeds[index], self._rigs[index], folder)
        return folder

    def _render(self, seed: int, drawn: DrawnRig, folder: Path) -> None:
        """Writes to a temporary folder and renames it, so that an interrupted process leaves no partial drive."""
        self._assets = self._assets or Assets.build()
        grid = self._config.bev_grid
        half_extent = max(abs(end) for end in (*grid.x_range_m, *grid.y_range_m))
        drive = RenderedDrive(
            seed, FRAMES_PER_DRIVE, self._config.rate_hz, drawn, assets=self._assets,
            supersampling=drawn.supersampling, map_half_extent_m=half_extent,
        )  # fmt: skip
        unfinished = folder.with_suffix(f"{UNFINISHED}{os.getpid()}")
        remove_abandoned(folder.parent, f"{folder.stem}{UNFINISHED}")
        export_drive(drive, unfinished, quality=drawn.jpeg_quality)
        try:
            os.replace(unfinished, folder)
        except OSError:
            if not folder.exists():
                raise
            shutil.rmtree(unfinished)  # another process has rendered the same drive meanwhile


def count_frames(drives: Drives) -> int:
    """The number of frames of all drives. Opens each of them."""
    return sum(len(drives.open(index).stamps) for index in range(len(drives)))


@dataclass(frozen=True)
class Split:
    """The sequence folders of a split file: to train on, and to score on."""

    train: tuple[Path, ...]
    validate: tuple[Path, ...]


KEYS = ("train", "validate")


def read_split(path: Path) -> Split:
    """The drives in a TOML file with the keys train and validate.

        train = ["drives/2024-*"]
        validate = ["drives/2025-01", "drives/2025-02"]

    Folders are relative to the file; *, ? and [abc] stand for the folders that match, in the order of their names.
    Raises InputError for another key, a list that leaves no drive, or a drive that is missing or stands there twice.
    """
    table = parse_toml(read_text(path, TOML_BYTES), path)
    if set(table) != set(KEYS):
        raise InputError(f"{path}: expected the keys {' and '.join(KEYS)}, found {', '.join(table) or 'none'}")
    split = Split(*(_folders(path, key, table[key]) for key in KEYS))
    times = Counter(folder.resolve() for folder in (*split.train, *split.validate))
    twice = [str(folder) for folder, count in times.items() if count > 1]
    if twice:
        raise InputError(f"{path}: {twice[0]} stands there twice: a drive is trained on or scored on, once")
    return split


def write_split(path: Path, split: Split) -> None:
    """Write a split file with absolute paths. Raises OutputError."""
    for_glob = {key: [glob.escape(str(folder.resolve())) for folder in getattr(split, key)] for key in KEYS}
    text = "".join(f"{key} = {json.dumps(folders, ensure_ascii=False)}\n" for key, folders in for_glob.items())
    write_whole(path, text.encode())


def training_drives(
    data: DriveOptions, held_out: int, cache: Path, config: ModelConfig, rigs: RigDistribution | None
) -> tuple[FolderDrives, FolderDrives]:
    """The drives to train on, and those to score on: of the split file, or else the last `held_out` (0: all).

    Raises InputError as `read_split`, where a seed is reserved for evaluation, and where no drive is left to train on.
    """
    highest = max(data.rendered or (0,))
    if highest >= FIRST_HELD_OUT_SEED:
        raise InputError(
            f"`rendered` (`--rendered`): seed {highest} is reserved for evaluation; train on seeds below "
            f"{FIRST_HELD_OUT_SEED}"
        )
    if data.split is not None:
        split = _only_split(data, data.split)
        train, validate = (FolderDrives(folders, config, data.class_map) for folders in (split.train, split.validate))
        return train, validate
    count = len(data.data if data.rendered is None else data.rendered)
    if 0 < count <= held_out:
        raise InputError(
            f"{count} drives are too few with {held_out} of them held out for evaluation: give more, "
            "or set held_out = 0 in [training] to evaluate on the training drives"
        )
    first = max(count - held_out, 0)
    drives = _opened(data, slice(first), cache, config, rigs)
    return drives, _opened(data, slice(first, None), cache, config, rigs) if held_out else drives


def scored_drives(
    data: DriveOptions, config: ModelConfig, rig: CameraRig | RigDistribution | None = None
) -> FolderDrives:
    """The drives to score on. rig: of rendered ones, as for `RenderedDrives`. Raises InputError as `read_split`."""
    if data.split is None:
        return _opened(data, slice(None), data.cache, config, rig)
    return FolderDrives(_only_split(data, data.split).validate, config, data.class_map)


def _opened(
    data: DriveOptions, part: slice, cache: Path, config: ModelConfig, rig: CameraRig | RigDistribution | None
) -> FolderDrives:
    """Some of the drives in folders, or of the rendered ones. Raises InputError where both or neither are given."""
    if bool(data.data) == (data.rendered is not None):
        raise InputError(
            "choose the drives: give either `data` (`--data DIR`) (repeatable), `rendered` (`--rendered SEEDS`) or "
            "`split` (`--split FILE`)"
        )
    if data.rendered is None:
        return FolderDrives(data.data[part], config, data.class_map)
    return RenderedDrives(data.rendered[part], cache, config, rig, data.class_map)


def _only_split(data: DriveOptions, path: Path) -> Split:
    if data.data or data.rendered is not None:
        name = "data" if data.data else "rendered"
        raise InputError(f"{path}: states the drives: remove `{name}` (`--{name}`), or `split` (`--split`)")
    return read_split(path)


def _folders(path: Path, key: str, names: object) -> tuple[Path, ...]:
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f'{path}: {key}: expected a list of folders, such as ["drives/a"], found {names!r:.60}')
    folders: list[Path] = []
    for name in names:
        matching = sorted(glob.glob(str(path.parent / name))) if set(name) & set("*?[") else [str(path.parent / name)]
        if not matching or not all(Path(folder).exists() for folder in matching):
            raise InputError(f"{path}: {key}: {name}: there is no such folder")
        folders += map(Path, matching)
    if not folders:
        raise InputError(f"{path}: {key}: leaves no drive (expected at least one folder)")
    return tuple(folders)


class FrameMemory:
    """Keeps decoded frames of several sequences, without the bytes of files, while its memory lasts.

    Frames beyond it are read each time. A copy in another process begins empty. Frames are shared: do not change their
    images in place.
    """

    def __init__(self, most_bytes: int) -> None:
        """most_bytes: of decoded images that are kept."""
        self._most_bytes = self._left_bytes = most_bytes
        self._frames: dict[tuple[int, int], Frame] = {}

    def __reduce__(self) -> tuple[type["FrameMemory"], tuple[int]]:
        return FrameMemory, (self._most_bytes,)

    def load(self, sequence: Drive, key: int, index: int) -> Frame:
        """The frame at an index of a sequence, whose number is `key`."""
        if (key, index) in self._frames:
            return self._frames[key, index]
        frame = sequence.load(index)
        images = {name: replace(image, encoded=None, media_type=None) for name, image in frame.images.items()}
        frame = replace(frame, images=images)
        size = sum(image.pixels_bgr.nbytes for image in images.values())
        if size <= self._left_bytes:
            self._left_bytes -= size
            self._frames[key, index] = frame
        return frame


class KeptFrames(DerivedDrive):
    """A sequence whose frames come from a `FrameMemory`, in which its number is `key`."""

    def __init__(self, sequence: Drive, memory: FrameMemory, key: int) -> None:
        super().__init__(sequence)
        self._memory, self._key = memory, key

    def ground_truth_frame(self, index: int) -> Frame:
        return self.drive.ground_truth_frame(index)

    def load(self, index: int) -> Frame:
        return self._memory.load(self.drive, self._key, index)
