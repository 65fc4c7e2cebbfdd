"""A ROS 2 bag or an MCAP file as a drive: its frames, and the images of its messages.

Image messages are compressed files, raw pixels in ROS's encodings, or video packets. OpenCV decodes files only. So the
packets from a keyframe to the next are written to a temporary file, and read from it.
"""

import re
import tempfile
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import CameraImage, DriveFacts
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.parsing.files import is_there
from bevcli.parsing.images import decode_image, media_type_of, size_of_image
from bevcli.printing import one_line
from bevcli.sequences import images
from bevcli.sequences.files.calibration_file import CALIBRATION, RigDraft, draft_of, draft_rig
from bevcli.sequences.files.ego_motion_file import DrivePoses, ReadPoses, read_poses
from bevcli.sequences.images import MOST_PIXELS, VideoReader
from bevcli.sequences.native.folder import decided
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import BagOptions, is_packed_bag, is_ros_bag
from bevcli.workshop.formats.matching import CameraImages, frames_at
from bevcli.workshop.formats.poses import refuse_statements
from bevcli.workshop.formats.ros.bag import Bag, CameraTopics, TopicFinder, read_topics_file
from bevcli.workshop.formats.ros.messages import payload, timestamp_ns
from bevcli.workshop.formats.ros.vehicle import VehicleReader, capture_times, find_geo_origin

# Encoding -> channels, bytes a channel, conversion to BGR. ROS names the top left 2x2 pixels of a Bayer pattern.
RAW_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "bgr8": (3, 1, None),
    "8UC3": (3, 1, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2BGR),
    "bgra8": (4, 1, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, 1, cv2.COLOR_RGBA2BGR),
    "mono8": (1, 1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, 1, cv2.COLOR_GRAY2BGR),
    "mono16": (1, 2, cv2.COLOR_GRAY2BGR),
    "bgr16": (3, 2, None),
    "rgb16": (3, 2, cv2.COLOR_RGB2BGR),
    "uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": (2, 1, cv2.COLOR_YUV2BGR_YUYV),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUYV),
}
for pattern in ("rggb", "bggr", "gbrg", "grbg"):
    for bits in (8, 16):
        conversion = getattr(cv2, f"COLOR_Bayer{pattern.upper()}2BGR")
        RAW_ENCODINGS[f"bayer_{pattern}{bits}"] = (1, bits // 8, conversion)
BAYER = re.compile("bayer_(rggb|bggr|gbrg|grbg)(8|16)")
COMPRESSED = re.compile("jpe?g|png|webp|tiff?|bmp", re.I)  # in the name of a format; "compressedDepth" is another one
VIDEO_FORMATS = ("h264", "h265")
LONGEST_GROUP = 600  # packets from one keyframe to the next
SAME_RATE = 0.98  # cameras whose rates differ by less have the same rate; the first of them leads
EGO_MOTION_FILE = "ego_motion.csv"


def bag_image(
    bag: Bag, topic: str, times_ns: NDArray[np.int64], numbers: NDArray[np.int64], index: int
) -> images.MessageSource:
    """Image `index` of a topic, read on demand. times_ns, numbers: (N,) of its messages in order of capture."""
    number, time_ns = int(numbers[index]), int(times_ns[index])
    name = f"{bag.path}: {topic}: message {number}"
    return images.MessageSource(name, time_ns, lambda: _read_message(bag, topic, number, time_ns, name))


def _read_message(bag: Bag, topic: str, index: int, time_ns: int, name: str) -> CameraImage:
    """The image, with the time that its message states.

    Raises UnreadableImage if it is broken, and InputError for an unknown encoding or format.
    """
    try:
        message = bag.message(topic, index)
    except InputError as error:
        raise images.UnreadableImage(str(error)) from None
    time, data = timestamp_ns(message) or time_ns, payload(message)
    if hasattr(message, "encoding"):
        return CameraImage(time, _raw_pixels(message, data, name))
    codec = str(getattr(message, "format", ""))
    pixels, is_as_stored = _decoded(data, codec)
    if pixels is None and codec and size_of_image(data) is None and not COMPRESSED.search(codec):
        raise InputError(
            f"{bag.path}: {topic}: images of format {one_line(codec, 60)} are not read (expected JPEG, PNG, WebP, "
            "TIFF or BMP, or video as foxglove.CompressedVideo): write the topic in one of these"
        )
    if pixels is None:
        raise images.UnreadableImage(f"{name} is not a complete image")
    media_type = media_type_of(data) if is_as_stored else None
    return CameraImage(time, pixels, data if media_type else None, media_type)


def _decoded(data: bytes, codec: str) -> tuple[NDArray[np.uint8] | None, bool]:
    """(H, W, 3) uint8 BGR of a compressed image, None for a broken one; False if the file shows other colours.

    codec: the format. After "compressed", ROS's image_transport names the encoding of what OpenCV compressed as if it
    were BGR or grey, such as in "rgb8; png compressed rgb8" and "bayer_rggb8; jpeg compressed ".
    """
    before, _, after = codec.partition("compressed")
    encoding = after.strip() or before.partition(";")[0]
    pixels = decode_image(data, cv2.IMREAD_UNCHANGED, MOST_PIXELS) if BAYER.fullmatch(encoding) else None
    if pixels is not None and pixels.ndim == 2:
        pixels = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
        return cv2.cvtColor(pixels, RAW_ENCODINGS[encoding][2] or 0).astype(np.uint8, copy=False), False
    pixels = decode_image(data, images.DECODE_FLAGS, MOST_PIXELS)
    if pixels is None or not (after.strip() and encoding.startswith("rgb")):
        return pixels, True
    return pixels[..., ::-1].copy(), False


def _raw_pixels(message: Any, data: bytes, where: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR of a sensor_msgs/Image or foxglove.RawImage.

    Raises InputError for an encoding that is not supported, and UnreadableImage if bytes are missing.
    """
    layout = RAW_ENCODINGS.get(str(message.encoding))
    if layout is None:
        raise InputError(
            f"{where}: encoding {message.encoding} is not supported (expected {', '.join(list(RAW_ENCODINGS)[:8])} or "
            "a Bayer pattern)"
        )
    channels, depth, conversion = layout
    height, width = int(message.height), int(message.width)
    row_bytes = width * channels * depth
    step = int(message.step) or row_bytes
    if len(data) < step * height or step < row_bytes:
        raise images.UnreadableImage(f"{where} is not a complete image")
    rows = np.frombuffer(data, dtype=np.uint8, count=step * height).reshape(height, step)[:, :row_bytes]
    pixels = np.ascontiguousarray(rows)
    if depth == 2:
        wide = pixels.view(">u2" if getattr(message, "is_bigendian", 0) else "<u2")
        pixels = (wide >> 8).astype(np.uint8)
    pixels = pixels.reshape(height, width, channels) if channels > 1 else pixels
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion).astype(np.uint8, copy=False)


class BagVideo:
    """The images of a topic with video packets. In order, each packet is decoded once.

    Raises InputError for a format that is not supported.
    """

    def __init__(self, bag: Bag, topic: str, times_ns: NDArray[np.int64], numbers: NDArray[np.int64]) -> None:
        """times_ns, numbers: (N,) of the topic's messages in order of capture."""
        self._bag, self._topic, self._times, self._numbers = bag, topic, times_ns.tolist(), numbers.tolist()
        self._format = str(bag.message(topic, 0).format).lower()
        if self._format not in VIDEO_FORMATS:
            expected = " or ".join(VIDEO_FORMATS)
            raise InputError(f"{bag.path}: {topic}: video format {self._format} is not supported (expected {expected})")
        self._folder = tempfile.TemporaryDirectory(prefix="bevcli-video-")
        self._group: range = range(0)  # messages of the group of pictures that is open
        self._reader: VideoReader | None = None
        self._lock = threading.Lock()

    def image(self, index: int) -> images.MessageSource:
        """The source of image `index`."""
        name = f"{self._bag.path}: {self._topic}: message {self._numbers[index]}"
        return images.MessageSource(name, self._times[index], lambda: self.read(index))

    def read(self, index: int) -> CameraImage:
        """Image `index`. Raises UnreadableImage if it cannot be decoded."""
        with self._lock:
            try:
                if index not in self._group:
                    self._open_group(index)
                assert self._reader is not None
                pixels = self._reader.read(index - self._group.start)
                time = timestamp_ns(self._bag.message(self._topic, self._numbers[index])) or self._times[index]
            except InputError as error:
                raise images.UnreadableImage(f"{self._topic}: image {index} cannot be decoded ({error})") from None
        return CameraImage(time, pixels)

    def _open_group(self, index: int) -> None:
        start = index
        while not _is_keyframe(self._packet(start), self._format):
            start -= 1
            if start < 0 or index - start > LONGEST_GROUP:
                raise InputError("there is no keyframe before it")
        stop = index + 1
        while stop < len(self._numbers) and not _is_keyframe(self._packet(stop), self._format):
            stop += 1
        path = Path(self._folder.name) / f"{start}.{self._format}"
        path.write_bytes(b"".join(self._packet(number) for number in range(start, stop)))
        if self._reader is not None:
            self._reader.path.unlink(missing_ok=True)
        self._reader, self._group = VideoReader(path), range(start, stop)

    def _packet(self, index: int) -> bytes:
        return payload(self._bag.message(self._topic, self._numbers[index]))


def _is_keyframe(packet: bytes, video_format: str) -> bool:
    """True for a packet at which decoding can start. Foxglove's schema puts parameter sets before each keyframe."""
    heads = [unit[0] for unit in packet.split(b"\x00\x00\x01")[1:] if unit]  # first bytes of NAL units in Annex B
    if video_format == "h264":
        return any(head & 0x1F == 7 for head in heads)  # a parameter set, as for H.265
    return any(head >> 1 & 0x3F in (32, 33) for head in heads)


def open_bag(path: Path, common: InputOptions, options: BagOptions) -> images.ListedDrive:
    """A bag as a `Drive`. Opening it reads the index, the calibration, the poses and the times of the images.

    The camera with the lowest rate leads: each of its images is a frame, with the other cameras' nearest images.

    Raises InputError if the bag is broken, or cameras, extrinsics or poses are not found.
    """
    if path.suffix == ".bag" and not is_ros_bag(path):
        raise InputError(
            f"{path}: is a bag of ROS 1: convert it (`rosbags-convert --src {path.name} --dst {path.stem}`)"
        )
    if path.is_file() and is_packed_bag(path):
        raise InputError(f"{path}: is compressed: decompress it first (such as zstd -d {path.name})")
    stated_topics = read_topics_file(options.topics_file, options.topics)
    draft = draft_of(options, path)
    rig = None if draft is None else draft.rig
    bag = Bag(path)
    rig, facts, file, beside = _files_beside(path.parent if path.is_file() else path, rig, common, options)
    finder = TopicFinder(bag, stated_topics, rig.names if rig else None)
    reader = VehicleReader(bag, finder, stated_topics)
    used_rig, with_images = reader.rig() if rig is None else rig, {camera.camera for camera in finder.cameras}
    lost = [name for name in used_rig.names if name not in with_images]
    used_rig = replace(used_rig, cameras=tuple(each for each in used_rig.cameras if each.name in with_images))
    entries = _entries(bag, finder.cameras)
    frame_times = np.array([entry.stamp.timestamp_ns for entry in entries], dtype=np.int64)
    anywhere = replace(common, allow_outside=True)  # images are messages, not files below a folder
    source, draft = "", draft or RigDraft(used_rig, ())
    if file is not None and common.ego_motion != "static":
        poses = read_poses(file, DrivePoses(used_rig, options, frame_times, bool(draft.readings)))
    else:
        refuse_statements(path, options)
        motion, source, motion_notes = reader.motion(common.ego_motion)
        poses = ReadPoses(motion, motion_notes)
    entries, gaps = _covered(entries, poses.motion, path)
    any_rig = images.ListedDrive(path, anywhere, used_rig, entries, None)
    draft, poses = decided(replace(draft, rig=used_rig), poses, any_rig, options)
    used_rig, motion = draft.rig, poses.motion
    geo_origin = facts.geo_origin or find_geo_origin(bag, motion)
    notes = (
        finder.table(source),
        *draft.notes,
        *bag.notes,
        *beside,
        *reader.notes,
        *([f"without images, left out: {', '.join(lost)}"] if lost else []),
        *(f"{name} is not used: no CameraInfo belongs to it" for name in finder.left_out),
        *images.bev_frame_notes(used_rig, "the calibration" if rig else "a bag"),
        *poses.notes,
        *gaps,
    )
    sequence = images.ListedDrive(path, anywhere, used_rig, entries, motion, notes=notes, input_files=bag.file_paths)
    sequence.facts = replace(facts, geo_origin=geo_origin)
    if path.is_file():
        sequence.name = path.resolve().stem
    return sequence


def _files_beside(
    folder: Path, rig: CameraRig | None, common: InputOptions, options: BagOptions
) -> tuple[CameraRig | None, DriveFacts, Path | None, list[str]]:
    """Rig, facts, ego-motion file and notes: those of files beside the bag, where no others are given."""
    calibration, notes = folder / CALIBRATION, []
    draft = draft_rig(calibration, folder).checked(calibration) if is_there(calibration) else None
    rig_beside, facts = (None, DriveFacts()) if draft is None else (draft.rig, draft.facts)
    if rig is None and rig_beside is not None:
        notes.append(f"{calibration} is used in place of the calibration in the bag")
    file = options.ego_motion_file
    if file is None and common.ego_motion != "static" and is_there(folder / EGO_MOTION_FILE):
        file = folder / EGO_MOTION_FILE
        notes.append(f"{file} is used in place of the poses in the bag")
    return rig_beside if rig is None else rig, facts, file, notes


def _entries(bag: Bag, cameras: tuple[CameraTopics, ...]) -> tuple[images.FrameEntry, ...]:
    """One frame for each image of the camera with the lowest rate, with the other cameras' nearest images."""
    cameras_images: dict[str, CameraImages] = {}
    captured = capture_times(bag, [camera.images for camera in cameras])
    for camera in cameras:
        times, numbers = captured[camera.images]
        # The median time between images; a second for a single one.
        period = float(np.median(np.diff(times))) if len(times) > 1 else 1e9
        image = BagVideo(bag, camera.images, times, numbers).image if camera.is_video else partial(
            bag_image, bag, camera.images, times, numbers
        )  # fmt: skip
        cameras_images[camera.camera] = CameraImages(camera.images, times, period, image)
    slowest = max(images.period_ns for images in cameras_images.values())
    leading = next(name for name, images in cameras_images.items() if images.period_ns >= SAME_RATE * slowest)
    return frames_at(np.unique(cameras_images[leading].times_ns), cameras_images, leading)


def _covered(
    entries: tuple[images.FrameEntry, ...], motion: EgoMotion | None, path: Path
) -> tuple[tuple[images.FrameEntry, ...], tuple[str, ...]]:
    """The frames with poses around all of their images, and notes. Localisation often starts later than the cameras."""
    if motion is None:
        return entries, ()
    kept = tuple(entry for entry in entries if motion.covered(entry.times_ns).all())
    if not kept:
        begin, end = entries[0].stamp.timestamp_ns, entries[-1].stamp.timestamp_ns
        raise InputError(
            f"{path}: the poses ({motion.first_ns} to {motion.last_ns} ns) and the images ({begin} to {end} ns) do not "
            "overlap in time: pass `ego_motion_file` (`--ego-motion FILE`) for these images"
        )
    left_out = len(entries) - len(kept)
    note = f"{left_out} of {len(entries)} frames are left out: there are no poses at their times"
    return kept, (note,) if left_out else ()
