"""A DGP scene as a Sequence, with its 3D boxes."""

from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.ego_motion import motion_of_keyframes
from bevcli.geometry.transforms import Array, yaw_of_rotation
from bevcli.sequences.files.class_names import ClassNames, count_classes
from bevcli.sequences.images import FrameEntry, ImageSource, ListedSequence, leads_out, read_frame
from bevcli.sequences.native.folder import rig_notes
from bevcli.sequences.options import FormatOptions, SequenceOptions
from bevcli.sequences.tracks import with_track_velocities
from bevcli.workshop.formats.dgp.records import Record, Sample, poses, read_record, read_samples

TENFOLD = "the times of the scene are after the year 2116: they are taken as ten times too large, as in DDAD"
BOXES_3D = "1"  # the number of 3D boxes among DGP's kinds of annotations
SIZE = ("length", "width", "height")
# DDAD's class names; docs/other-inputs.md says what is lost. Names are compared without case; others, such as Wheeled
# Slow and Train, stay as they are, and are not scored.
CLASS_OF_NAME = {
    "Person": "pedestrian",
    "Pedestrian": "pedestrian",
    "Bus/RV/Caravan": "bus",
    "Towed Object": "trailer",
    "Caravan/RV": "truck",
}


class DgpSequence(ListedSequence):
    """The samples of a DGP scene. Point clouds are not read, only the boxes that are annotated in them.

    The ego frame is DDAD's: below the rear axle, on the ground. Raises InputError.
    """

    has_ego_motion = True

    def __init__(
        self, path: Path, common: SequenceOptions = SequenceOptions(), own: FormatOptions = FormatOptions()
    ) -> None:
        common.refuse_static(path)
        self.path, self.name = path, path.resolve().name
        scene, self._outside = read_record(_scene_file(path)), common.allow_outside
        samples, tenfold = read_samples(path, scene)
        images = {name: image for sample in samples for name, image in sample.images().items()}
        if not images:
            raise InputError(f"{scene.where}: no sample has an image (expected at least one)")
        self._rigs = tuple(sample.rig(images) for sample in samples)
        self.rig = self._rigs[0]
        self._list(tuple(self._entry(index, sample) for index, sample in enumerate(samples)), path, common)
        self.ego_motion = motion_of_keyframes(poses(samples, keys=True), poses(samples, keys=False))
        self._truth = self._read_truth(scene, samples, common.class_map) if common.ground_truth else {}
        self.notes = (*rig_notes(self.rig, "a DGP scene"), *((TENFOLD,) if tenfold else ()))

    @property
    def input_files(self) -> tuple[Path, ...]:
        return tuple(sorted((*self.path.glob("scene_*.json"), *self.path.glob("calibration/*.json"))))

    @property
    def class_counts(self) -> Mapping[str, int]:
        return count_classes(self._truth.values())

    def _frame(self, place: int, entry: FrameEntry) -> Frame:
        return read_frame(entry, self._rigs[place], self._images, self.ego_motion, self._truth.get(place))

    def _entry(self, index: int, sample: Sample) -> FrameEntry:
        sources = {
            datum.sensor: ImageSource(self._file(datum.content, "filename"), datum.time_ns)
            for datum in sample.data
            if datum.is_image
        }
        dropped = {name: "no image in the sample" for name in self.rig.names if name not in sources}
        return FrameEntry(FrameStamp(index, "", sample.time_ns), sources, dropped, str(self.path))

    def _file(self, record: Record, member: str) -> Path:
        """The file that a member names. Raises InputError if it leads out of the scene."""
        name = record.text(member)
        file = PurePosixPath(name)
        if not self._outside and leads_out(self.path / file, self.path):
            where = f"{record.where}: {name:.100}"
            raise InputError(f"{where}: leads out of the folder: pass `allow_outside=True` to read it")
        return self.path / file

    def _read_truth(self, scene: Record, samples: Iterable[Sample], class_map: Mapping[str, str]) -> dict[int, Boxes3D]:
        """The boxes in the world frame of each sample that has a point cloud with boxes."""
        found, times = {}, []
        classes: dict[int, str] | None = None
        for place, sample in enumerate(samples):
            for cloud in (datum for datum in sample.data if not datum.is_image):
                annotations = cloud.content.record("annotations")
                if BOXES_3D in annotations.value:
                    classes = _read_ontology(self.path, scene, class_map) if classes is None else classes
                    file = self._file(annotations, BOXES_3D)
                    found[place] = _read_boxes(file, cloud.world_from_sensor.matrix, classes)
                    times.append(sample.time_ns)
                    break
        return dict(zip(found, with_track_velocities(list(found.values()), times), strict=True))


def _scene_file(path: Path) -> Path:
    files = sorted(path.glob("scene_*.json"))
    if len(files) == 1:
        return files[0]
    found = ", ".join(file.name for file in files[:4]) or "none"
    raise InputError(f"{path}: expected one file scene_*.json, found {found}")


def _read_ontology(folder: Path, scene: Record, class_map: Mapping[str, str]) -> dict[int, str]:
    """The class of each `class_id` of 3D boxes. Raises InputError. folder: of the scene."""
    names = ClassNames.of_format(CLASS_OF_NAME, class_map)
    items = read_record(folder / "ontology" / f"{scene.record('ontologies').text(BOXES_3D)}.json").records("items")
    return {item.integer("id", 0): names[item.text("name")] for item in items}


def _read_boxes(path: Path, world_from_sensor: Array, classes: Mapping[int, str]) -> Boxes3D:
    """The boxes of a sensor in the world frame, without velocities. Raises InputError."""
    records = read_record(path).records("annotations")
    if not records:
        return Boxes3D.empty()
    boxes = [record.record("box") for record in records]
    world_from_box = [world_from_sensor @ box.record("pose").pose().matrix for box in boxes]
    ids = [record.integer("class_id", 0) for record in records]
    things = [record.integer("instance_id", 0) for record in records]  # 0 is that of a box without one
    return Boxes3D(
        np.stack([pose[:3, 3] for pose in world_from_box]),
        np.stack([box.numbers(SIZE) for box in boxes]),
        np.array([yaw_of_rotation(pose[:3, :3]) for pose in world_from_box]),
        np.full((len(boxes), 2), np.nan),
        np.array([classes.get(number, f"class {number}") for number in ids], dtype=np.str_),
        instances=np.array([str(one or "") for one in things], dtype=np.str_),
        num_points=np.array([record.integer("num_points", 0) for record in records], dtype=np.int64),
    )
