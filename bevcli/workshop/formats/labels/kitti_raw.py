"""Labels of KITTI raw, tracklet_labels.xml: tracks, as KITTI, `bevcli export` and CVAT write them."""

from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from bevcli.errors import InputError
from bevcli.parsing.documents import parse_xml
from bevcli.parsing.files import MIB, read_bytes
from bevcli.workshop.formats.labels.cuboid import IN_EGO, Cuboid, cuboid_of, labels_of_cuboids
from bevcli.workshop.formats.labels.label_format import LabelFormat, Labels, starts_with

LARGEST_BYTES = 32 * MIB  # a tree of elements takes thirty times as much
CVAT_VERSION = "0"  # of the poses; KITTI's is 2
VEHICLE_M, NARROW_M = 2.5, 1.0  # a longer and wider box lies along its length
OUT_OF_IMAGE = "2"


def read_tracklets(path: Path) -> Labels:
    """The poses of all tracklets, which are instances; the boxes are taken to be in the ego frame. Raises InputError.

    KITTI states height, width and length as h, w and l, and the middle of the bottom. CVAT ("Kitti Raw Format 1.0")
    states the sizes along x, y and z as w, h and l, and the middle of the box; where its track has a gap, a pose is out
    of the image. Datumaro has CVAT's middle, and the sizes of the file that it converted: those of KITTI where this
    gives more tracks the shape of an object.
    """
    content = read_bytes(path, LARGEST_BYTES).replace(b'standalone="true"', b'standalone="yes"', 1)  # KITTI's own files
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
    listed = (((index, None), frames[index]) for index in sorted(frames))
    return labels_of_cuboids("ego", listed, IN_EGO, *notes, lists_empty=False)


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
    for place, pose in enumerate(track.iterfind("poses/item")):
        if is_cvats and pose.findtext("truncation") == OUT_OF_IMAGE:
            continue
        position, rotation = _numbers(where, pose, "tx", "ty", "tz"), _numbers(where, pose, "rx", "ry", "rz")
        if not is_cvats:
            position[2] += size[2] / 2
        yield int(first) + place, cuboid_of(where, kind, number, position, rotation, size)


def _numbers(where: str, element: Element, *names: str) -> list[float]:
    try:
        numbers = [float(element.findtext(name, "")) for name in names]
    except ValueError:
        numbers = [np.nan]
    if not np.isfinite(numbers).all():
        raise InputError(f"{where}: {', '.join(names)}: expected a number for each")
    return numbers


FORMAT = LabelFormat(
    "KITTI raw or CVAT tracklets (tracklet_labels.xml)",
    lambda path: starts_with(path, ".xml", "boost_serialization"),
    lambda path, rig, options: read_tracklets(path),
)
