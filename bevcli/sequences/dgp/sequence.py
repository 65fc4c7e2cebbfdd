"""A DGP scene as a Sequence."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import Frame, FrameStamp, Sequence
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.ego_motion import motion_of_keyframes
from bevcli.sequences.dgp.boxes import read_boxes, read_ontology
from bevcli.sequences.dgp.records import BOXES_3D, Record, inside, read_record
from bevcli.sequences.dgp.samples import Sample, poses, read_samples, sizes
from bevcli.sequences.files.class_names import count_classes
from bevcli.sequences.images import FrameEntry, ImageReader, ImageSource, read_frame
from bevcli.sequences.native.folder import rig_notes
from bevcli.sequences.options import FormatOptions, SequenceOptions
from bevcli.sequences.tracks import with_track_velocities

TENFOLD = "the times of the scene are after the year 2116: they are taken as ten times too large, as in DDAD"


class DgpSequence(Sequence):
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
        self._entries = tuple(self._entry(index, sample) for index, sample in enumerate(samples))
        self._rigs = tuple(sample.calibration.rig(sizes(sample)) for sample in samples)
        self.rig = self._rigs[0]
        if any(rig.names != self.rig.names for rig in self._rigs):
            raise InputError(
                f"{scene.where}: the samples have different cameras (expected {', '.join(self.rig.names)})"
            )
        self.stamps = tuple(entry.stamp for entry in self._entries)
        self.ego_motion = motion_of_keyframes(poses(samples, keys=True), poses(samples, keys=False))
        self._truth = self._read_truth(scene, samples, common.class_map) if common.ground_truth else {}
        self.notes = (*rig_notes(self.rig, "a DGP scene"), *((TENFOLD,) if tenfold else ()))
        self._images = ImageReader(strict=common.strict, inside=None if common.allow_outside else path)

    @property
    def input_files(self) -> tuple[Path, ...]:
        """The scene and its calibrations."""
        return tuple(sorted((*self.path.glob("scene_*.json"), *self.path.glob("calibration/*.json"))))

    @property
    def class_counts(self) -> Mapping[str, int]:
        return count_classes(self._truth.values())

    def image_files(self, place: int) -> tuple[Path, ...]:
        return self._entries[place].image_files

    def ground_truth_frame(self, place: int) -> Frame:
        entry = self._entries[place]
        return self._frame(place, FrameEntry(entry.stamp, {}, {}, entry.origin))

    def load(self, place: int) -> Frame:
        return self._frame(place, self._entries[place])

    def _frame(self, place: int, entry: FrameEntry) -> Frame:
        return read_frame(entry, self._rigs[place], self._images, self.ego_motion, self._truth.get(place))

    def _entry(self, index: int, sample: Sample) -> FrameEntry:
        sources = {
            datum.sensor: ImageSource(self._file(datum.content.text("filename"), datum.content), datum.time_ns)
            for datum in sample.data
            if datum.is_image
        }
        return FrameEntry(FrameStamp(index, "", sample.time_ns), sources, {}, str(self.path))

    def _file(self, name: str, record: Record) -> Path:
        return self.path / inside(name, record.where, allow_outside=self._outside)

    def _read_truth(self, scene: Record, samples: Iterable[Sample], class_map: Mapping[str, str]) -> dict[int, Boxes3D]:
        """The boxes in the world frame of each sample that has a point cloud with boxes."""
        found, times = {}, []
        classes: dict[int, str] | None = None
        for place, sample in enumerate(samples):
            for datum in sample.data:
                if datum.is_image or BOXES_3D not in datum.content.record("annotations").value:
                    continue
                classes = read_ontology(self.path, scene, class_map) if classes is None else classes
                annotations = datum.content.record("annotations")
                file = self._file(annotations.text(BOXES_3D), annotations)
                found[place] = read_boxes(file, datum.world_from_sensor.matrix, classes)
                times.append(sample.time_ns)
                break
        return dict(zip(found, with_track_velocities(list(found.values()), times), strict=True))


def _scene_file(path: Path) -> Path:
    files = sorted(path.glob("scene_*.json"))
    if len(files) == 1:
        return files[0]
    found = ", ".join(file.name for file in files[:4]) or "none"
    raise InputError(f"{path}: expected one file scene_*.json, found {found}")
