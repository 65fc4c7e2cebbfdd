"""A nuScenes dataset root as a Sequence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.transforms import Pose
from bevcli.sequences.images import ImageReader, ImageSource
from bevcli.sequences.nuscenes.cache import open_index
from bevcli.sequences.nuscenes.choice import NuScenesChoice, chosen_scenes, tables_of
from bevcli.sequences.nuscenes.frames import keyframes, sweep_frames
from bevcli.sequences.nuscenes.index import Ints
from bevcli.sequences.nuscenes.scene import SceneFacts, read_scene_facts, scene_rig


@dataclass(frozen=True)
class _FrameEntry:
    """A frame before its images are read.

    Attributes:
        stamp: index, scene and time of the frame.
        scene: row of the scene in the index.
        sample: row of the sample in the index, None between keyframes.
        rows: rows of the frame's images in the index.
    """

    stamp: FrameStamp
    scene: int
    sample: int | None
    rows: Ints


class NuScenesSequence:
    """Frames of a nuScenes root, scene after scene, numbered from 0: keyframes, and sweeps if they are chosen.

    The bev frame is the scene's LIDAR_TOP frame. The world frame is that of nuScenes' map.
    allow_outside: whether images may lie outside of the root.
    Raises InputError if a table is missing or invalid, or the choice contains no scene.
    """

    has_ego_motion = True

    def __init__(
        self,
        root: Path,
        choice: NuScenesChoice = NuScenesChoice(),
        *,
        strict: bool = False,
        allow_outside: bool = False,
    ) -> None:
        self.root = root
        self.tables = tables_of(root, choice.version)
        self.index, note = open_index(self.tables)
        scenes = chosen_scenes(self.index, self.tables, choice)
        self.name = choice.scene or choice.split or self.tables.name
        self.rig = scene_rig(self.index, scenes[0])[0]
        self._frames = tuple(self._find_frames(scenes, choice.sweeps))
        self._images = ImageReader(strict=strict, inside=None if allow_outside else root)
        self._facts = lru_cache(maxsize=2)(partial(read_scene_facts, self.index, root))
        self.notes = tuple(text for text in (note, self._can_bus_note(scenes)) if text)

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """Index, scene and time of each frame, in order."""
        return tuple(entry.stamp for entry in self._frames)

    @property
    def input_files(self) -> tuple[Path, ...]:
        """The tables. A run can be resumed only if they are the same."""
        return tuple(sorted(self.tables.glob("*.json")))

    def load(self, place: int) -> Frame:
        """The frame at position `place`, with decoded images. Raises InputError as `ImageReader.read`."""
        entry = self._frames[place]
        facts = self._facts(entry.scene)
        rows = {facts.sensor_names[int(self.index.images.sensors[row])]: int(row) for row in entry.rows}
        dropped = {name: "no image in sample_data.json" for name in facts.rig.names if name not in rows}
        sources = {name: self._source(rows[name]) for name in facts.rig.names if name in rows}
        images, dropped = self._images.read(sources, facts.rig, dropped)
        pose = self._pose(entry, facts)
        return Frame(
            stamp=entry.stamp,
            rig=facts.rig,
            images=images,
            world_from_ego=pose,
            world_from_ego_at={n: self._image_pose(rows[n]) if n in rows else pose for n in facts.rig.names},
            kinematics=facts.kinematics_at(entry.stamp.timestamp_ns),
            dropped=dropped,
            ground_truth=None if entry.sample is None else self.index.ground_truth(entry.sample),
            sample_token=None if entry.sample is None else self.index.samples.tokens[entry.sample].decode(),
        )

    def _find_frames(self, scenes: Iterable[int], sweeps: bool) -> Iterable[_FrameEntry]:
        number = 0
        for scene in scenes:
            found = sweep_frames(self.index, scene) if sweeps else keyframes(self.index, scene)
            name = str(self.index.scenes.names[scene])
            for time_us, sample, rows in found:
                yield _FrameEntry(FrameStamp(number, name, time_us * 1000), scene, sample, rows)
                number += 1

    def _source(self, row: int) -> ImageSource:
        images = self.index.images
        return ImageSource(self.root / images.files[row].decode(), int(images.times_us[row]) * 1000)

    def _image_pose(self, row: int) -> Pose:
        images = self.index.images
        return Pose(np.array(images.translations[row]), np.array(images.quaternions[row]))

    def _pose(self, entry: _FrameEntry, facts: SceneFacts) -> Pose:
        if entry.sample is None:
            return facts.motion.pose_at(entry.stamp.timestamp_ns)
        samples = self.index.samples
        return Pose(np.array(samples.translations[entry.sample]), np.array(samples.quaternions[entry.sample]))

    def _can_bus_note(self, scenes: Iterable[int]) -> str:
        names = [str(self.index.scenes.names[scene]) for scene in scenes]
        without = [name for name in names if not (self.root / "can_bus" / f"{name}_pose.json").is_file()]
        if not without:
            return ""
        which = without[0] if len(without) == 1 else f"{len(without)} of {len(names)} scenes"
        return f"{which}: no CAN bus data in {self.root / 'can_bus'}; kinematics are derived from the poses"
