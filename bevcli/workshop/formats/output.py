"""Writers of drives frame by frame: what those of all formats share, and that of native folders."""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bevcli.errors import InputError, OutputError
from bevcli.frame import CameraImage, DriveFacts, Frame, FrameResult, Ground
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion, Kinematics
from bevcli.geometry.transforms import Pose
from bevcli.parsing.images import encode_image
from bevcli.printing import cell_of
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.sequences.files.calibration_file import camera_to_json, write_calibration
from bevcli.sequences.files.ego_motion_file import ACCELERATION, ANGULAR_RATE, QUATERNION, TRANSLATION, VELOCITY
from bevcli.sequences.files.map_folder import write_map
from bevcli.sequences.native.folder import BOXES_FILE, LINES_FILE, MAPS_FOLDER, FolderDrive
from bevcli.sequences.options import InputOptions
from bevcli.writing import output_errors, remove_parts, whole_file, write_whole

FORMATS = {"image/jpeg": "jpeg", "image/png": "png"}
SUFFIXES = {"jpeg": ".jpg", "png": ".png"}


class DriveWriter(AbstractContextManager["DriveWriter"], Protocol):
    """Writes a drive frame by frame: `with writer: writer.write(frame)`. What it writes is valid after the block only.

    After an error in the block, nothing under the final name opens as a drive.
    """

    def write(self, frame: Frame) -> None:
        """Write a frame and its images. Raises InputError for one that the format cannot hold, and OutputError."""


@contextmanager
def whole_folder(folder: Path, parts: Iterable[str]) -> Iterator[None]:
    """Make a folder, in which the block writes files and folders of these names; after an error they are deleted.

    So is the folder itself if it was missing before. Other files in it are kept.
    Raises OutputError where the folder cannot be made.
    """
    is_new = not folder.exists()
    with output_errors(folder, "created"):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            remove_parts(folder, parts)
            if is_new:
                folder.rmdir()
        raise


class FolderWriter(ExitStack):
    """Base of a `DriveWriter` of a folder: a subclass has `write` and `_finish`. After an error, its parts are deleted.

    Files that a subclass enters into the stack are closed before `_finish`.

    Attributes:
        folder: that is written.
    """

    def __init__(self, folder: Path, parts: Collection[str], *, force: bool, can_replace: bool = True) -> None:
        """Make room in the folder.

        parts: names of the files and folders that are written, and that `force` removes; others are kept.
        can_replace: whether what is there may be replaced.
        Raises OutputError if the folder has files that are not to be replaced, or it cannot be written.
        """
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file (expected a folder to write)")
        if folder.is_dir() and any(folder.iterdir()):
            if not (force and can_replace):
                way = ", or pass `force=True` (`--force`) to replace it" if can_replace else ""
                raise OutputError(f"{folder}: exists already: choose another folder{way}")
            remove_parts(folder, parts)
        super().__init__()
        self.folder = folder
        self.enter_context(whole_folder(folder, parts))
        self.push(self._close)

    def _close(self, error_type: type[BaseException] | None, *error: object) -> None:
        if error_type is None:
            self._finish()
            try:
                self._read_back()
            except InputError as error:
                raise InputError(f"{self.folder}: is not written, because it could not be read: {error}") from None

    def _finish(self) -> None:
        """Write what needs all frames."""

    def _read_back(self) -> None:
        """Open what was written, so that nothing is left that a run would refuse. Raises InputError."""

    def _write_image(self, name: str, image: CameraImage) -> str:
        """Write the file of an image; returns its path relative to the folder, with suffix."""
        content, form = image_file(image)
        write_whole(self.folder / f"{name}{SUFFIXES[form]}", content, parents=True)
        return f"{name}{SUFFIXES[form]}"


def image_file(image: CameraImage) -> tuple[bytes, str]:
    """The file of an image as it was read, or else a PNG; and its format, "jpeg" or "png"."""
    form = FORMATS.get(image.media_type or "")
    if image.encoded is None or form is None:
        return encode_image(image.pixels_bgr, ".png"), "png"
    return image.encoded, form


# The files that the writer creates and `force` removes. Other files in the folder are kept.
PARTS = ("calibration.json", "frames.csv", "ego_motion.csv", "images", BOXES_FILE, MAPS_FOLDER, LINES_FILE)


class NativeWriter(FolderWriter):
    """Writes a native sequence folder frame by frame.

        with NativeWriter(folder, with_ego_motion=True) as writer:
            writer.write(frame)

    Image files are copied byte for byte; images of a video become PNG. ego_motion.csv gets the pose at the time of
    every frame and image. After an error, what was written is deleted. calibration.json is written last, so that a
    killed process leaves no valid sequence.

    with_ego_motion: whether the frames have poses. force: replace a sequence in the folder. facts: of the drive.
    Raises OutputError if the folder exists and `force` is false, or it cannot be written. Raises InputError for a
    frame with another calibration than the first or a repeated index, and for scenes that overlap in time.
    """

    def __init__(
        self, folder: Path, *, with_ego_motion: bool, force: bool = False, facts: DriveFacts | None = None
    ) -> None:
        super().__init__(folder, PARTS, force=force)
        self._drive_facts = facts or DriveFacts()
        self._with_ego_motion, self._reference = with_ego_motion, "world" if with_ego_motion else "ego"
        self._rig: CameraRig | None = None
        self._numbers: set[int] = set()
        self._motion: dict[int, tuple[Pose, Kinematics]] = {}
        self._scenes: dict[str, tuple[int, int]] = {}  # first and last time of each scene, ns
        self._boxes: BoxesWriter | None = None
        self._results: dict[type[FrameResult], Any] = {}  # type of results -> what its `writer` made
        try:
            table = self.enter_context((folder / "frames.csv").open("w", newline="", encoding="utf-8"))
        except OSError as error:
            raise OutputError(f"{folder / 'frames.csv'}: cannot be written ({error.strerror})") from None
        self._rows = csv.writer(table, lineterminator="\n")

    def write(self, frame: Frame) -> None:
        self._check(frame)
        number = f"{frame.stamp.index:06d}"
        cells = {name: self._write_image(f"images/{name}/{number}", image) for name, image in frame.images.items()}
        self._write_row(frame, cells)
        if self._with_ego_motion:
            self._store_motion(frame)
        pose = frame.world_from_ego if self._with_ego_motion else None
        if frame.ground_truth is not None:
            self._write_boxes(frame, frame.ground_truth, pose)
        if frame.ground_truth_map is not None:
            write_map(self.folder / MAPS_FOLDER, frame.stamp.index, frame.ground_truth_map)
        for result in frame.ground_truth_results:
            self._write_result(Ground(frame.stamp, frame.rig.ego_from_bev, pose), result)

    def _finish(self) -> None:
        if self._rig is None:
            raise OutputError(f"{self.folder}: no frame was written (expected at least one)")
        if self._with_ego_motion:
            self._check_scenes()
            write_ego_motion(self.folder / "ego_motion.csv", _ego_motion(self._motion))
        write_calibration(self.folder / "calibration.json", self._rig, self._drive_facts)

    def _read_back(self) -> None:
        FolderDrive(self.folder, InputOptions(ego_motion="optional"))

    def _check(self, frame: Frame) -> None:
        stamp = frame.stamp
        if self._rig is None:
            self._rig = frame.rig
            cameras = [cell_of(name) for name in frame.rig.names]
            times = [f"{name}.timestamp_ns" for name in cameras]
            self._rows.writerow(["frame", "scene", "timestamp_ns", *cameras, *times])
        elif frame.rig is not self._rig and not same_rig(frame.rig, self._rig):
            raise InputError(
                f"frame {stamp.index} ({stamp.scene}): its calibration differs from the first frame's, but a native "
                "sequence has a single calibration: convert scene by scene (`scene` (`--scene`))"
            )
        if stamp.index in self._numbers:
            raise InputError(f"frame {stamp.index} ({stamp.scene}): its index occurred before: renumber the frames")
        self._numbers.add(stamp.index)

    def _write_row(self, frame: Frame, cells: Mapping[str, str]) -> None:
        names = frame.rig.names
        times = [frame.images[name].timestamp_ns if name in cells else "" for name in names]
        stamp = frame.stamp
        row = [stamp.index, cell_of(stamp.scene), stamp.timestamp_ns, *(cells.get(name, "") for name in names), *times]
        self._rows.writerow(row)

    def _store_motion(self, frame: Frame) -> None:
        for name, image in frame.images.items():
            self._motion.setdefault(image.timestamp_ns, (frame.world_from_ego_at[name], frame.kinematics))
        self._motion[frame.stamp.timestamp_ns] = (frame.world_from_ego, frame.kinematics)
        times = [frame.stamp.timestamp_ns, *(image.timestamp_ns for image in frame.images.values())]
        times += self._scenes.get(frame.stamp.scene, ())
        self._scenes[frame.stamp.scene] = (min(times), max(times))

    def _check_scenes(self) -> None:
        """Raise InputError if scenes overlap in time: they share one ego_motion.csv."""
        spans = sorted((first, last, name) for name, (first, last) in self._scenes.items())
        for (_, end, earlier), (start, _, later) in pairwise(spans):
            if start <= end:
                raise InputError(
                    f"scenes {earlier} and {later} overlap in time: convert scene by scene (`scene` (`--scene`))"
                )

    def _write_boxes(self, frame: Frame, boxes: Boxes3D, pose: Pose | None) -> None:
        if self._boxes is None:
            self._boxes = self.enter_context(BoxesWriter(self.folder / BOXES_FILE, self._reference))
        extras = {"sample_token": frame.sample_token} if frame.sample_token else {}
        self._boxes.write(FrameBoxes(frame.stamp, pose, boxes, extras))

    def _write_result(self, ground: Ground, result: FrameResult) -> None:
        kind = type(result)
        if kind not in self._results:
            writer = kind.writer(self.folder / kind.true_file, self._reference, {"classes": list(kind.true_names)})
            self._results[kind] = self.enter_context(writer)
        self._results[kind].write(ground, result)


def _ego_motion(rows: Mapping[int, tuple[Pose, Kinematics]]) -> EgoMotion:
    times = sorted(rows)
    poses, kinematics = zip(*(rows[time] for time in times), strict=True)
    return EgoMotion(
        np.array(times, dtype=np.int64),
        np.stack([pose.translation for pose in poses]),
        np.stack([pose.quaternion for pose in poses]),
        *map(np.stack, zip(*(vars(k).values() for k in kinematics), strict=True)),
    )


def same_rig(first: CameraRig, second: CameraRig) -> bool:
    """True if all names and numbers of two rigs are equal."""
    return (
        first.names == second.names
        and np.array_equal(first.ego_from_bev, second.ego_from_bev)
        and all(camera_to_json(a) == camera_to_json(b) for a, b in zip(first.cameras, second.cameras, strict=True))
    )


def write_ego_motion(path: Path, motion: EgoMotion) -> None:
    """Write all columns, so that `read_ego_motion` returns the same numbers. Raises OutputError."""
    columns = (motion.translations, motion.quaternions, motion.accelerations, motion.angular_rates, motion.velocities)
    numbers = np.concatenate(columns, axis=1)  # (T, 16)
    with whole_file(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["timestamp_ns", *TRANSLATION, *QUATERNION, *ACCELERATION, *ANGULAR_RATE, *VELOCITY])
        for time, row in zip(motion.timestamps_ns, numbers, strict=True):
            writer.writerow([int(time), *(repr(float(value)) for value in row)])
