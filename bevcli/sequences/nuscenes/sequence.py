"""A nuScenes dataset root as a Sequence."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from bevcli.frame import Frame, FrameStamp, Sequence
from bevcli.geometry.transforms import Pose, inverse
from bevcli.sequences.images import ImageReader, ImageSource
from bevcli.sequences.nuscenes.cache import open_index
from bevcli.sequences.nuscenes.choice import chosen_scenes, keyframes, sweep_frames, tables_of
from bevcli.sequences.nuscenes.format import NuScenesOptions
from bevcli.sequences.nuscenes.index import NUSCENES, Dialect, Images, Ints, Samples
from bevcli.sequences.nuscenes.map_expansion import MapExpansion
from bevcli.sequences.nuscenes.scene import read_scene, scene_rig
from bevcli.sequences.options import SequenceOptions


@dataclass(frozen=True)
class _FrameEntry:
    """A frame before its images are read. scene, sample and rows of images: in the index. sample: None for a sweep."""

    stamp: FrameStamp
    scene: int
    sample: int | None
    rows: Ints


class TableSequence(Sequence):
    """Frames of a folder with nuScenes' tables, scene after scene, numbered from 0.

    Args:
        root: the folder that file names are relative to.
        tables: the folder with the tables.
        common: the options of every format.
        dialect: the points in which the tables differ from nuScenes' own.
        own: only the scenes of its split; whether images between the keyframes make frames too.

    Raises InputError if a table is missing or invalid, or the choice contains no scene.
    """

    has_ego_motion = True

    def __init__(
        self, root: Path, tables: Path, common: SequenceOptions, dialect: Dialect, own: NuScenesOptions
    ) -> None:
        common.refuse_static(root)
        self.root, self.tables, self.dialect = root, tables, dialect
        self.index, note = open_index(tables, dialect)
        self.scenes = chosen_scenes(self.index, tables, own.split, common.scene)
        self.rig = scene_rig(self.index, dialect, self.scenes[0])
        self._frames = tuple(self._find_frames(own.sweeps))
        self.stamps = tuple(entry.stamp for entry in self._frames)
        self._images = ImageReader(strict=common.strict, inside=None if common.allow_outside else root)
        self._scene = lru_cache(maxsize=2)(partial(read_scene, self.index, root, dialect))
        self.notes = (note,) if note else ()

    @property
    def input_files(self) -> tuple[Path, ...]:
        """The tables. A run can be resumed only if they are the same."""
        return tuple(sorted(self.tables.glob("*.json")))

    @property
    def class_counts(self) -> Mapping[str, int]:
        first, categories = self.index.samples.first_annotation, self.index.annotations.categories
        found: Counter[bytes] = Counter()
        for sample in (entry.sample for entry in self._frames if entry.sample is not None):
            found.update(categories[first[sample] : first[sample + 1]].tolist())
        counts: Counter[str] = Counter()
        for category, count in found.items():
            if name := self.dialect.class_of(category.decode()):
                counts[name] += count
        return counts

    def image_files(self, place: int) -> tuple[Path, ...]:
        return tuple(self._source(int(row)).path for row in self._frames[place].rows)

    def ground_truth_frame(self, place: int) -> Frame:
        return self._frame(self._frames[place], with_images=False)

    def load(self, place: int) -> Frame:
        return self._frame(self._frames[place], with_images=True)

    def _frame(self, entry: _FrameEntry, *, with_images: bool) -> Frame:
        rig, motion, kinematics = self._scene(entry.scene)
        names = self.index.sensors.channels[self.index.images.sensors[entry.rows]]
        rows = {str(name): int(row) for name, row in zip(names, entry.rows, strict=True)}
        dropped = {name: "no image in sample_data.json" for name in rig.names if name not in rows}
        sources = {name: self._source(rows[name]) for name in rig.names if name in rows and with_images}
        images, dropped = self._images.read(sources, rig, dropped)
        sample, index = entry.sample, self.index
        pose = motion.pose_at(entry.stamp.timestamp_ns) if sample is None else _pose_of(index.samples, sample)
        return Frame(
            stamp=entry.stamp,
            rig=rig,
            images=images,
            world_from_ego=pose,
            world_from_ego_at={n: _pose_of(index.images, rows[n]) if n in rows else pose for n in rig.names},
            kinematics=kinematics.kinematics_at(entry.stamp.timestamp_ns),
            dropped=dropped,
            ground_truth=None if sample is None else index.ground_truth(sample, self.dialect.class_of),
            sample_token=None if sample is None else index.samples.tokens[sample].decode(),
        )

    def _find_frames(self, sweeps: bool) -> Iterable[_FrameEntry]:
        number = 0
        for scene in self.scenes:
            found = sweep_frames(self.index, scene) if sweeps else keyframes(self.index, scene)
            name = str(self.index.scenes.names[scene])
            for time_us, sample, rows in found:
                yield _FrameEntry(FrameStamp(number, name, time_us * 1000), scene, sample, rows)
                number += 1

    def _source(self, row: int) -> ImageSource:
        images = self.index.images
        return ImageSource(self.root / images.files[row].decode(), int(images.times_us[row]) * 1000)


class NuScenesSequence(TableSequence):
    """Frames of a nuScenes root: keyframes, and sweeps if they are chosen.

    The bev frame is the scene's LIDAR_TOP frame. The world frame is that of nuScenes' map. Keyframes have true lines of
    the map where the root has the map expansion.
    Raises InputError as `TableSequence`.
    """

    def __init__(
        self, root: Path, common: SequenceOptions = SequenceOptions(), own: NuScenesOptions = NuScenesOptions()
    ) -> None:
        tables = tables_of(root, own.version)
        super().__init__(root, tables, common, NUSCENES, own)
        self.name = common.scene or own.split or tables.name
        self._maps = MapExpansion(root, tables) if common.ground_truth else None
        note = self._can_bus_note()
        self.notes = (*self.notes, note) if note else self.notes

    def _frame(self, entry: _FrameEntry, *, with_images: bool) -> Frame:
        frame = super()._frame(entry, with_images=with_images)
        if self._maps is None or entry.sample is None:
            return frame
        bev_from_world = inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev)
        return replace(frame, ground_truth_lines=self._maps.lines(frame.stamp.scene, bev_from_world))

    def _can_bus_note(self) -> str:
        names = [str(self.index.scenes.names[scene]) for scene in self.scenes]
        without = [name for name in names if not (self.root / "can_bus" / f"{name}_pose.json").is_file()]
        if not without:
            return ""
        which = without[0] if len(without) == 1 else f"{len(without)} of {len(names)} scenes"
        return f"{which}: no CAN bus data in {self.root / 'can_bus'}; kinematics are derived from the poses"


def _pose_of(table: Images | Samples, row: int) -> Pose:
    return Pose(np.array(table.translations[row]), np.array(table.quaternions[row]))
