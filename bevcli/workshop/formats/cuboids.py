"""Labels of CVAT and KITTI raw: cuboids that are drawn into a point cloud, turned about three axes."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import msgspec
import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.parsing.documents import parse_xml
from bevcli.parsing.files import MIB, read_bytes
from bevcli.workshop.formats.labels import LabelFormat, LabelledFrame, Labels, Moment

FIRST_BYTES = 4096
LARGEST_JSON, LARGEST_XML = 1024 * MIB, 32 * MIB  # a tree of elements takes thirty times as much
LARGEST_TILT_DEG = 5.0
IN_EGO = 'the cuboids are taken to be in the "ego" frame: that of the point clouds that were labelled'
CUBOID = "cuboid_3d"
CVAT_VERSION = "0"  # of the poses of tracklets; KITTI's is 2
VEHICLE_M, NARROW_M = 2.5, 1.0  # a longer and wider box lies along its length
OUT_OF_IMAGE = "2"


@dataclass(frozen=True)
class Cuboid:
    """A cuboid. box: the upright box with its heading. tilt_deg: angle between its vertical and that of the frame."""

    box: Boxes3D
    tilt_deg: float


def cuboid_of(
    where: str, kind: str, track: str, position: Sequence[float], rotation: Sequence[float], size: Sequence[float]
) -> Cuboid:
    """A cuboid of numbers from a file, of unknown velocity. Raises InputError.

    kind: name of the class. track: identity, "" for none. position: (3,) of the middle, metres. rotation: (3,) angles
    about x, y and z, radians: Rx Ry Rz. size: (3,) length, width and height, metres.
    """
    numbers = position, rotation, size
    if [len(each) for each in numbers] != [3, 3, 3] or not np.isfinite(numbers).all():
        raise InputError(f"{where}: expected three numbers each of position, rotation and size")
    (sx, sy, sz), (cx, cy, cz) = np.sin(rotation), np.cos(rotation)
    yaw = np.arctan2(cx * sz + sx * sy * cz, cy * cz)
    box = Boxes3D(
        np.array([position]), np.array([size]), np.array([yaw]), np.full((1, 2), np.nan), np.array([kind]),
        instances=np.array([track]),
    )  # fmt: skip
    return Cuboid(box, float(np.degrees(np.arccos(cx * cy))))


def _labels_of(frames: Iterable[tuple[Moment, list[Cuboid]]], *notes: str, lists_empty: bool) -> Labels:
    """The labels of frames with their cuboids, in the ego frame, and a note about tilted ones."""
    listed = list(frames)
    tilted = sum(cuboid.tilt_deg > LARGEST_TILT_DEG for _, cuboids in listed for cuboid in cuboids)
    if tilted:
        notes = (*notes, f"{tilted} cuboids are tilted by more than {LARGEST_TILT_DEG:g}°: their boxes are upright")
    labelled = (
        LabelledFrame(*moment, Boxes3D.concatenate(cuboid.box for cuboid in cuboids)) for moment, cuboids in listed
    )
    return Labels("ego", tuple(labelled), lists_empty, (IN_EGO, *notes))


def _starts_with(path: Path, ending: str, word: bytes) -> bool:
    if path.suffix.lower() != ending or not path.is_file():
        return False
    with path.open("rb") as file:
        return word in file.read(FIRST_BYTES)


class _Annotation(msgspec.Struct):
    type: str
    label_id: int | None = None
    position: list[float] = []
    rotation: list[float] = []  # radians about x, y and z: Rx Ry Rz
    scale: list[float] = []  # length, width, height
    attributes: dict[str, str | int | float | bool | None] = {}


class _Attributes(msgspec.Struct):
    frame: int | None = None


class _Item(msgspec.Struct):
    id: str
    attr: _Attributes = msgspec.field(default_factory=_Attributes)
    annotations: list[_Annotation] = []


class _Label(msgspec.Struct):
    name: str


class _Labels(msgspec.Struct):
    labels: list[_Label]


class _Categories(msgspec.Struct):
    label: _Labels


class _File(msgspec.Struct):
    categories: _Categories
    items: list[_Item]


def read_cvat_labels(path: Path) -> Labels:
    """The cuboids of annotations/default.json in the exported archive. Tracks are instances. Raises InputError.

    CVAT's cuboids are in the frame of the point cloud, which is taken to be the ego frame.
    """
    try:
        content = msgspec.json.decode(read_bytes(path, LARGEST_JSON), type=_File)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InputError(f'{path}: is not a CVAT export "Datumaro 3D": {error}') from None
    classes = [label.name for label in content.categories.label.labels]
    return _labels_of((_frame(path, item, classes) for item in content.items), lists_empty=True)


def _frame(path: Path, item: _Item, classes: list[str]) -> tuple[Moment, list[Cuboid]]:
    where = f"{path}: item {item.id:.40}"
    if item.attr.frame is None:
        raise InputError(f'{where}: "attr" has no "frame", the index of the frame')
    return (item.attr.frame, None), [_cuboid(where, one, classes) for one in item.annotations if one.type == CUBOID]


def _cuboid(where: str, drawn: _Annotation, classes: list[str]) -> Cuboid:
    if drawn.label_id is None or not 0 <= drawn.label_id < len(classes):
        raise InputError(f'{where}: label_id is {drawn.label_id} (expected 0 to {len(classes) - 1}, from "categories")')
    track = drawn.attributes.get("track_id")
    name, identity = classes[drawn.label_id], "" if track is None else str(track)
    return cuboid_of(where, name, identity, drawn.position, drawn.rotation, drawn.scale)


CVAT = LabelFormat(
    'a CVAT export "Datumaro 3D" (annotations/default.json)',
    lambda path: _starts_with(path, ".json", b'"categories"'),
    lambda path, rig, options: read_cvat_labels(path),
)


def read_tracklets(path: Path) -> Labels:
    """The poses of all tracklets, which are instances; the boxes are taken to be in the ego frame. Raises InputError.

    KITTI states height, width and length as h, w and l, and the middle of the bottom. CVAT ("Kitti Raw Format 1.0")
    states the sizes along x, y and z as w, h and l, and the middle of the box; where its track has a gap, a pose is out
    of the image. Datumaro has CVAT's middle, and the sizes of the file that it converted: those of KITTI where this
    gives more tracks the shape of an object.
    """
    content = read_bytes(path, LARGEST_XML).replace(b'standalone="true"', b'standalone="yes"', 1)  # KITTI's own files
    tracks = parse_xml(content, path).findall("tracklets/item")
    frames: dict[int, list[Cuboid]] = {}
    sizes = [_numbers(f"{path}: tracklet {number}", track, *"whl") for number, track in enumerate(tracks)]
    order = "lwh" if sum(map(_votes_for_kitti, sizes)) > 0 else "whl"
    for number, track in enumerate(tracks):
        for index, cuboid in _cuboids(f"{path}: tracklet {number}", track, str(number), order):
            frames.setdefault(index, []).append(cuboid)
    names = ", ".join(order)
    note = f"the poses have CVAT's version: {names} are taken to be the sizes along x, y and z, tz to be the middle"
    notes = [note] if any(map(_is_cvats, tracks)) else []
    return _labels_of((((index, None), frames[index]) for index in sorted(frames)), *notes, lists_empty=False)


def _is_cvats(track: Element) -> bool:
    return track.findtext("poses/item_version", "").strip() == CVAT_VERSION


def _votes_for_kitti(size: list[float]) -> int:
    """1 where w, h and l have the shape of an object only as width, height and length; -1 only as CVAT's x, y and z."""
    width, height, length = size
    as_kitti = length >= width
    as_cvat = width >= height and not (length > VEHICLE_M and min(width, height) > NARROW_M)  # no car stands upright
    return as_kitti - as_cvat


def _cuboids(where: str, track: Element, number: str, order: str) -> Iterator[tuple[int, Cuboid]]:
    """Index of the frame and cuboid of each pose. order: of the sizes along x, y and z in a file of CVAT's version."""
    kind, is_cvats = track.findtext("objectType", "").strip(), _is_cvats(track)
    if not kind:
        raise InputError(f"{where}: objectType is missing")
    size, (first,) = _numbers(where, track, *(order if is_cvats else "lwh")), _numbers(where, track, "first_frame")
    for index, pose in enumerate(track.iterfind("poses/item"), int(first)):
        if is_cvats and pose.findtext("truncation") == OUT_OF_IMAGE:
            continue
        position, rotation = _numbers(where, pose, "tx", "ty", "tz"), _numbers(where, pose, "rx", "ry", "rz")
        if not is_cvats:
            position[2] += size[2] / 2
        yield index, cuboid_of(where, kind, number, position, rotation, size)


def _numbers(where: str, element: Element, *names: str) -> list[float]:
    try:
        numbers = [float(element.findtext(name, "")) for name in names]
    except ValueError:
        numbers = [np.nan]
    if not np.isfinite(numbers).all():
        raise InputError(f"{where}: {', '.join(names)}: expected a number for each")
    return numbers


TRACKLETS = LabelFormat(
    "KITTI raw or CVAT tracklets (tracklet_labels.xml)",
    lambda path: _starts_with(path, ".xml", b"boost_serialization"),
    lambda path, rig, options: read_tracklets(path),
)
