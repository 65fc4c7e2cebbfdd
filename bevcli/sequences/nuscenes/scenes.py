"""A nuScenes dataset root as a Sequence, read directly (the official devkit needs an old NumPy)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.transforms import Pose
from bevcli.sequences.images import ImageReader, ImageSource
from bevcli.sequences.nuscenes.cache import open_index
from bevcli.sequences.nuscenes.index import Ints, NuScenesIndex
from bevcli.sequences.nuscenes.scene import SceneFacts, read_scene_facts, scene_rig
from bevcli.sequences.nuscenes.splits import SPLITS, split_of
from bevcli.sequences.nuscenes.sweeps import sweep_frames


@dataclass(frozen=True)
class NuScenesChoice:
    """Which part of a dataset: version None is the only one there; scene and split None are all; sweeps too or not."""

    version: str | None = None
    scene: str | None = None
    split: str | None = None
    sweeps: bool = False


@dataclass(frozen=True)
class _Moment:
    """A frame before its images are read. sample: its place for a keyframe. rows: its images' rows."""

    stamp: FrameStamp
    scene: int
    sample: int | None
    rows: Ints


class NuScenesSequence:
    """Keyframes of nuScenes (and the images between, if asked for), scene after scene, numbered from 0.

    The bev frame is the scene's LIDAR_TOP. The world is the map's frame.
    """

    has_ego_motion = True

    def __init__(self, root: Path, choice: NuScenesChoice = NuScenesChoice(), *, strict: bool = False) -> None:
        self.root = root
        self.tables = tables_of(root, choice.version)
        self.index, note = open_index(self.tables)
        scenes = chosen_scenes(self.index, self.tables, choice)
        self.name = choice.scene or choice.split or self.tables.name
        self.rig = scene_rig(self.index, scenes[0])[0]
        self._moments = tuple(self._find_moments(scenes, choice.sweeps))
        self._images = ImageReader(strict=strict)
        self._facts = lru_cache(maxsize=2)(partial(read_scene_facts, self.index, root))
        self.notes = tuple(text for text in (note, self._can_bus_note(scenes)) if text)

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """When each frame is, in order."""
        return tuple(moment.stamp for moment in self._moments)

    def load(self, place: int) -> Frame:
        """The frame at a place, its images decoded. Raises InputError for wrong sizes, or missing ones if strict."""
        moment = self._moments[place]
        facts = self._facts(moment.scene)
        rows = {facts.sensor_names[int(self.index.images.sensors[row])]: int(row) for row in moment.rows}
        dropped = {name: "no image in sample_data.json" for name in facts.rig.names if name not in rows}
        sources = {name: self._source(rows[name]) for name in facts.rig.names if name in rows}
        images, dropped = self._images.read(sources, facts.rig, dropped)
        pose = self._pose(moment, facts)
        return Frame(
            stamp=moment.stamp,
            rig=facts.rig,
            images=images,
            world_from_ego=pose,
            world_from_ego_at={n: self._image_pose(rows[n]) if n in rows else pose for n in facts.rig.names},
            kinematics=facts.kinematics_at(moment.stamp.timestamp_ns),
            dropped=dropped,
            ground_truth=None if moment.sample is None else self.index.ground_truth(moment.sample),
            sample_token=None if moment.sample is None else self.index.samples.tokens[moment.sample].decode(),
        )

    def _find_moments(self, scenes: Iterable[int], sweeps: bool) -> Iterable[_Moment]:
        number = 0
        for scene in scenes:
            found = sweep_frames(self.index, scene) if sweeps else _keyframes(self.index, scene)
            name = str(self.index.scenes.names[scene])
            for time_us, sample, rows in found:
                yield _Moment(FrameStamp(number, name, time_us * 1000), scene, sample, rows)
                number += 1

    def _source(self, row: int) -> ImageSource:
        images = self.index.images
        return ImageSource(self.root / images.files[row].decode(), int(images.times_us[row]) * 1000)

    def _image_pose(self, row: int) -> Pose:
        images = self.index.images
        return Pose(np.array(images.translations[row]), np.array(images.quaternions[row]))

    def _pose(self, moment: _Moment, facts: SceneFacts) -> Pose:
        if moment.sample is None:
            return facts.motion.pose_at(moment.stamp.timestamp_ns)
        samples = self.index.samples
        return Pose(np.array(samples.translations[moment.sample]), np.array(samples.quaternions[moment.sample]))

    def _can_bus_note(self, scenes: Iterable[int]) -> str:
        names = [str(self.index.scenes.names[scene]) for scene in scenes]
        without = [name for name in names if not (self.root / "can_bus" / f"{name}_pose.json").is_file()]
        if not without:
            return ""
        which = without[0] if len(without) == 1 else f"{len(without)} of {len(names)} scenes"
        return f"{which}: no CAN bus data in {self.root / 'can_bus'}, so it is derived from the poses"


def is_nuscenes_root(path: Path) -> bool:
    """Whether a folder holds the tables of a nuScenes version, as ROOT/v1.0-mini/scene.json."""
    return bool(_versions(path))


def tables_of(root: Path, version: str | None) -> Path:
    """The folder of a version's tables. Raises InputError where it is missing, or several are there to choose from."""
    versions = _versions(root)
    if version is None and len(versions) == 1:
        return root / versions[0]
    if version in versions:
        return root / version
    found = ", ".join(versions) or "none"
    wanted = f'has no version "{version}"' if version else "has several versions: choose one with --version"
    raise InputError(f"{root}: {wanted} (found: {found})")


def chosen_scenes(index: NuScenesIndex, tables: Path, choice: NuScenesChoice) -> list[int]:
    """The places of the chosen scenes. Raises InputError where none is left."""
    names = [str(name) for name in index.scenes.names]
    if choice.split is not None and choice.split not in SPLITS:
        raise InputError(f'--split "{choice.split}": expected one of {", ".join(SPLITS)}')
    if choice.scene is not None and choice.scene not in names:
        few = ", ".join(names[:6]) + (f", ... {len(names)} in all" if len(names) > 6 else "")
        raise InputError(f'{tables}: has no scene "{choice.scene}" (found: {few})')
    mini = (choice.split or "").startswith("mini")
    scenes = [
        place
        for place, name in enumerate(names)
        if choice.scene in (None, name) and choice.split in (None, split_of(name, mini=mini))
    ]
    if not scenes:
        what = f"scene {choice.scene} is not in" if choice.scene else "no scene is in"
        raise InputError(f"{tables}: {what} the split {choice.split}: choose another --split or --version")
    return scenes


def _versions(root: Path) -> list[str]:
    return sorted(path.parent.name for path in root.glob("v1.*/scene.json"))


def _keyframes(index: NuScenesIndex, scene: int) -> Iterable[tuple[int, int, Ints]]:
    """Time in us, sample and image rows of each keyframe of a scene."""
    first, last = index.scenes.first_image[scene : scene + 2]
    keys = first + np.flatnonzero(index.images.keys[first:last])
    samples = index.images.samples[keys]
    keys = keys[np.argsort(samples, kind="stable")]
    start, end = index.scenes.first_sample[scene : scene + 2]
    bounds = np.searchsorted(np.sort(samples), np.arange(start, end + 1))
    for place, sample in enumerate(range(start, end)):
        yield int(index.samples.times_us[sample]), sample, keys[bounds[place] : bounds[place + 1]]
