"""A listed frame -> a Frame: its images, read from files or videos and decoded in parallel, and its poses."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError, result_within
from bevcli.frame import CameraImage, Drive, Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import BEV_ORIGIN, Camera, CameraRig
from bevcli.geometry.ego_motion import GRAVITY, EgoMotion, Kinematics
from bevcli.geometry.transforms import Pose
from bevcli.parsing.files import MIB, open_regular, plain_name, read_bytes
from bevcli.parsing.images import decode_image, media_type_of, size_of_image
from bevcli.sequences.files.boxes_file import count_classes
from bevcli.sequences.options import InputOptions

# Where the beginning of a file shows its container: offset and bytes. The last row is that of streams in bags.
CONTAINERS = (
    (4, b"ftyp"), (4, b"moov"), (4, b"mdat"), (4, b"wide"), (4, b"free"), (4, b"skip"), (0, b"RIFF"),
    (0, b"\x1a\x45\xdf\xa3"), (0, b"\x00\x00\x00\x01"), (0, b"\x00\x00\x01"),
)  # fmt: skip
TS_PACKET = 188  # bytes of an MPEG transport stream; each begins with G, in .m2ts after a time
MOST_PIXELS = 1 << 26  # of an image in a video or a bag


class VideoReader:
    """Reads the images of one video by index. In order, each image is decoded once; going back reopens the video."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture: cv2.VideoCapture | None = None
        self._at = -1  # index of the image in `_pixels`
        self._pixels: NDArray[np.uint8] | None = None
        self._end: int | None = None  # number of images, known once the end was reached

    def read(self, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 BGR of image `index`, from 0.

        Raises InputError if the file is missing, is not a video, or does not have the image.
        """
        if self._end is not None and index >= self._end:
            raise self._without(index)
        if self._capture is None or index < self._at:
            self._capture, self._at, self._pixels = open_capture(self.path), -1, None
        if index == self._at and self._pixels is not None:
            return self._pixels
        while self._at < index:
            grabbed = False
            with contextlib.suppress(cv2.error):  # a damaged stream
                grabbed = self._capture.grab()
            if not grabbed:
                self._end, self._capture = self._at + 1, None
                raise self._without(index)
            self._at += 1
        with contextlib.suppress(cv2.error):
            readable, pixels = self._capture.retrieve()
            if readable:
                self._pixels = pixels.astype(np.uint8, copy=False)
                return self._pixels
        raise InputError(f"{self.path}: image {index} cannot be decoded")

    def _without(self, index: int) -> InputError:
        last = f"the last is {self._end - 1}" if self._end else "none can be decoded, the file is damaged"
        return InputError(f"{self.path} has no image {index} ({last})")


def open_capture(path: Path) -> cv2.VideoCapture:
    """Open a video. Raises InputError if it is missing or OpenCV cannot read it."""
    with open_regular(path, missing="is missing") as file:
        start = file.read(2 * TS_PACKET)
    # FFmpeg recognises playlists too, which could lead it to other files and to servers.
    is_transport = any(start[offset::TS_PACKET][:2] == b"GG" for offset in (0, 4))
    if not is_transport and not any(start[offset:].startswith(magic) for offset, magic in CONTAINERS):
        raise InputError(f"{path} is not a video (expected MP4, MOV, MKV, WebM, AVI or MPEG-TS)")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # nothing: what fails here is told in one line
    set_log_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel  # OpenCV 4; OpenCV 5
    level = set_log_level(0)  # silent
    try:
        with plain_name(path) as name:
            capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    except cv2.error:
        capture = cv2.VideoCapture()
    finally:
        set_log_level(level)
    if not capture.isOpened():
        raise InputError(
            f"{path} cannot be opened as a video: it is cut short, has sound only, or a codec that is not read "
            "(expected one such as H.264 or FFV1)"
        )
    # The calibration is that of the pixels as they are stored, and versions of OpenCV differ in whether they turn them.
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    width, height = (capture.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if not 0 < width * height <= MOST_PIXELS:
        capture.release()
        raise InputError(f"{path} has images of {width:.0f}x{height:.0f} (expected at most {MOST_PIXELS} pixels)")
    return capture


def rotation_notes(paths: Iterable[Path]) -> Iterator[str]:
    """A note on each video with a tag by which players turn its images. Videos that cannot be read have none."""
    for path in paths:
        with contextlib.suppress(InputError):
            degrees = open_capture(path).get(cv2.CAP_PROP_ORIENTATION_META)
            if degrees % 360:
                yield f"{path}: has a rotation tag ({degrees:.0f} degrees): its images are read as they are stored"


DECODING_THREADS = 6
READING_TIMEOUT_S = 120.0
LARGEST_METADATA = 4 * MIB  # bytes of an image file beyond its pixels
# The calibration refers to the pixels as they are stored, so an EXIF orientation must not rotate them.
DECODE_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
AT_REST = Kinematics(np.array([0.0, 0.0, GRAVITY]), np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class ImageSource:
    """The place and the time of one image."""

    path: Path  # an image file or a video
    timestamp_ns: int  # time of the image
    video_index: int | None = None  # index of the image in the video, from 0. None for an image file

    def __str__(self) -> str:
        return str(self.path) if self.video_index is None else f"{self.path}#{self.video_index}"


def no_image_error(drive: str, reasons: Iterable[tuple[str, str]]) -> InputError:
    """The error of a drive of which not one image could be read. reasons: cameras and why; the first one is named."""
    why = next((f" (camera {camera}: {reason})" for camera, reason in reasons), "")
    return InputError(f"{drive}: not one image could be read{why}: bring the images back")


class UnreadableImage(Exception):
    """An image is missing or broken. The message is the reason."""


@dataclass(frozen=True)
class MessageSource:
    """One image of another format, which reads itself."""

    name: str  # of the file and the image in it, for messages
    timestamp_ns: int  # time of the image, at least roughly
    read: Callable[[], CameraImage]  # reads the image; may be called from several threads. Raises UnreadableImage

    def __str__(self) -> str:
        return self.name


Source: TypeAlias = ImageSource | MessageSource


class ImageReader:
    """Reads the images of frames, which should be asked for in order.

    strict: a missing or broken image raises InputError.
    inside: the folder that no path or link may lead out of. None: images may be anywhere.
    """

    def __init__(self, *, strict: bool = False, inside: Path | None = None) -> None:
        self._strict = strict
        self._inside = None if inside is None else os.path.realpath(inside)
        self._fitting: set[str] = set()  # cameras that had an image of the calibration's size
        self._videos: dict[str, VideoReader] = {}  # by camera, so that only one thread at a time uses a reader
        # One thread where OpenCV has one, as in a process that makes clips of many drives, all of them open.
        threads = DECODING_THREADS if cv2.getNumThreads() > 1 else 1
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="decode")

    def read(
        self, sources: Mapping[str, Source], rig: CameraRig, dropped: Mapping[str, str]
    ) -> tuple[dict[str, CameraImage], dict[str, str]]:
        """The images by camera, and the reasons for missing images by camera.

        dropped: cameras already known to have no image, with the reasons.
        Raises InputError where a camera's first image has another size than the calibration states, where an image
        lies outside of the folder, for a folder that is gone and, with `strict`, for a missing image. Raises WaitError
        if a disk does not answer.
        """
        if self._strict and dropped:
            camera, reason = next(iter(dropped.items()))
            raise InputError(f"camera {camera}: {reason}: add the image, or remove `strict=True` (`--strict`)")
        tasks = {name: self._threads.submit(self._read_one, source, rig[name]) for name, source in sources.items()}
        images: dict[str, CameraImage] = {}
        reasons = dict(dropped)
        for name, task in tasks.items():
            try:
                images[name] = result_within(task, READING_TIMEOUT_S, f"{sources[name]}: reading the image")
            except UnreadableImage as unreadable:
                if self._strict:
                    hint = "replace the image, or remove `strict=True` (`--strict`)"
                    raise InputError(f"camera {name}: {unreadable}: {hint}") from None
                reasons[name] = str(unreadable)
        if not images and self._inside is not None and not os.path.exists(self._inside):
            raise InputError(
                f"{self._inside}: the folder is gone (expected until the last frame is read): bring it back"
            )
        return images, reasons

    def _read_one(self, source: Source, camera: Camera) -> CameraImage:
        if isinstance(source, ImageSource):
            if self._inside is not None:
                try:
                    path = os.path.realpath(source.path)
                except ValueError:  # a null byte
                    raise UnreadableImage(f"{str(source.path)!r} is not a file name") from None
                if os.path.commonpath((path, self._inside)) != self._inside:
                    raise InputError(
                        f"{source.path}: leads out of the folder {self._inside} (to {path}): pass "
                        "`allow_outside=True` (`--allow-outside`) to read it"
                    )
            is_file = source.video_index is None
            image = self._read_file(source, camera) if is_file else self._read_video(source, camera.name)
        else:
            image = source.read()
        height, width = image.pixels_bgr.shape[:2]
        self._check_size(source, camera, (width, height))
        self._fitting.add(camera.name)
        return image

    def _check_size(self, source: Source, camera: Camera, size: tuple[int, int]) -> None:
        """Raises InputError for a wrong size of a camera's first image, UnreadableImage for that of a later one."""
        if size == (camera.width, camera.height):
            return
        problem = f"the image is {size[0]}x{size[1]} (expected {camera.width}x{camera.height}, as in the calibration)"
        if camera.name in self._fitting:
            raise UnreadableImage(f"{source}: {problem}")
        raise InputError(f"{source}: camera {camera.name}: {problem}: use the calibration of this image size")

    def _read_file(self, source: ImageSource, camera: Camera) -> CameraImage:
        """An image file. Its size is checked by its header, before it is decoded."""
        # An uncompressed image with four channels of 16 bits, and room for metadata.
        largest = 8 * camera.width * camera.height + LARGEST_METADATA
        try:
            encoded = read_bytes(source.path, largest, missing="is missing")
        except InputError as error:
            raise UnreadableImage(str(error)) from None
        size = size_of_image(encoded)
        if size is None:
            raise UnreadableImage(f"{source.path} is not a complete image (expected a JPEG or PNG)")
        self._check_size(source, camera, size)
        pixels = decode_image(encoded, DECODE_FLAGS, size[0] * size[1])
        if pixels is None:
            raise UnreadableImage(f"{source.path} is not a complete image")
        media_type = media_type_of(encoded)
        return CameraImage(source.timestamp_ns, pixels, encoded if media_type else None, media_type)

    def _read_video(self, source: ImageSource, camera: str) -> CameraImage:
        reader = self._videos.get(camera)
        if reader is None or reader.path != source.path:
            reader = self._videos[camera] = VideoReader(source.path)
        assert source.video_index is not None
        try:
            return CameraImage(source.timestamp_ns, reader.read(source.video_index))
        except InputError as error:
            raise UnreadableImage(str(error)) from None


@dataclass(frozen=True)
class FrameEntry:
    """One frame before its images are read. Each camera is in `sources` or in `dropped`."""

    stamp: FrameStamp  # index, scene and time of the frame
    sources: Mapping[str, Source]  # location of the image, by camera
    dropped: Mapping[str, str]  # reason why there is no image, by camera
    origin: str  # where the frame is listed, such as "frames.csv: line 3", for error messages

    @property
    def times_ns(self) -> list[int]:
        """The times of the frame and of its images."""
        return [self.stamp.timestamp_ns, *(source.timestamp_ns for source in self.sources.values())]


def leads_out(path: Path, folder: Path) -> bool:
    """True for a path that is not below the folder, by its names alone: links are followed when the image is read."""
    return not Path(os.path.abspath(path)).is_relative_to(os.path.abspath(folder))


def bev_frame_notes(rig: CameraRig, source: str = "calibration.json") -> tuple[str, ...]:
    """Tells the user that the bev frame is the default, if it is. source: what does not state it."""
    if not rig.ego_from_bev_assumed:
        return ()
    return (f'{source} has no "ego_from_bev": the default is used, a level frame at {BEV_ORIGIN} in ego',)


class ListedDrive(Drive):
    """A drive whose frames are listed, and whose images are read when a frame is loaded.

    Args:
        path: the drive, below which the images lie.
        common: the options of every format.
        rigs: the rig of all frames, or of each.
        entries: the frames.
        motion: the vehicle's poses; None if they are not known.
        truth: the boxes of frames in the world frame, by their places in the drive.
        notes: for the user.
        input_files: see `Drive`.
    """

    def __init__(
        self,
        path: Path,
        common: InputOptions,
        rigs: CameraRig | tuple[CameraRig, ...],
        entries: tuple[FrameEntry, ...],
        motion: EgoMotion | None,
        truth: Mapping[int, Boxes3D] | None = None,
        notes: tuple[str, ...] = (),
        input_files: tuple[Path, ...] = (),
    ) -> None:
        self.path, self.name, self.notes = path, path.resolve().name, notes
        self._rigs = (rigs,) * len(entries) if isinstance(rigs, CameraRig) else rigs
        self.rig, self.stamps, self._entries = self._rigs[0], tuple(entry.stamp for entry in entries), entries
        self.ego_motion, self.has_ego_motion, self._truth = motion, motion is not None, truth or {}
        self._images = ImageReader(strict=common.strict, inside=None if common.allow_outside else path)
        self._input_files = input_files

    @property
    def input_files(self) -> tuple[Path, ...]:
        return self._input_files

    @property
    def class_counts(self) -> Mapping[str, int]:
        return count_classes(self._truth.values())

    def image_files(self, index: int) -> tuple[Path, ...]:
        sources = self._entry(index).sources.values()
        return tuple(source.path for source in sources if isinstance(source, ImageSource))

    def ground_truth_frame(self, index: int) -> Frame:
        entry = self._entry(index)  # its reasons for missing images are left out: `strict` refuses them
        return self._frame(index, FrameEntry(entry.stamp, {}, {}, entry.origin))

    def load(self, index: int) -> Frame:
        return self._frame(index, self._entry(index))

    def _entry(self, index: int) -> FrameEntry:
        return self._entries[index]

    def _rig_and_motion(self, index: int) -> tuple[CameraRig, EgoMotion | None]:
        return self._rigs[index], self.ego_motion

    def _frame(self, index: int, entry: FrameEntry) -> Frame:
        """The frame at a place, of its entry or of one without images.

        Without ego-motion, poses are the identity, and the vehicle is at rest.
        Raises InputError as `ImageReader.read`, and for a time that the ego-motion does not cover.
        """
        (rig, motion), frame_ns = self._rig_and_motion(index), entry.stamp.timestamp_ns
        images, dropped = self._images.read(entry.sources, rig, entry.dropped)
        times = dict.fromkeys(rig.names, frame_ns)
        times |= {name: source.timestamp_ns for name, source in entry.sources.items()}
        times |= {name: image.timestamp_ns for name, image in images.items()}
        at_times = [frame_ns, *times.values()]
        poses = [Pose.identity() if motion is None else motion.pose_at(time) for time in at_times]
        return Frame(
            stamp=entry.stamp,
            rig=rig,
            images=images,
            world_from_ego=poses[0],
            world_from_ego_at=dict(zip(times, poses[1:], strict=True)),
            kinematics=AT_REST if motion is None else motion.kinematics_at(frame_ns),
            dropped=dropped,
            road_normal=None if motion is None else motion.road_normal_at(frame_ns),
            ground_truth=self._truth.get(index),
        )
