"""Labels of CVAT: the cuboids of a 3D task, exported as "Datumaro 3D"."""

from pathlib import Path

import msgspec

from bevcli.errors import InputError
from bevcli.workshop.formats.labels.cuboid import IN_EGO, Cuboid, cuboid_of, labels_of_cuboids
from bevcli.workshop.formats.labels.label_format import LabelFormat, Labels, Moment, decoded, starts_with

CUBOID = "cuboid_3d"


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
    content = decoded(path, _File, 'a CVAT export "Datumaro 3D"')
    classes = [label.name for label in content.categories.label.labels]
    frames = (_frame(path, item, classes) for item in content.items)
    return labels_of_cuboids("ego", frames, IN_EGO, lists_empty=True)


def _frame(path: Path, item: _Item, classes: list[str]) -> tuple[Moment, list[Cuboid]]:
    where = f"{path}: item {item.id:.40}"
    if item.attr.frame is None:
        raise InputError(f'{where}: "attr" has no "frame", the index of the frame')
    return (item.attr.frame, None), [_cuboid(where, one, classes) for one in item.annotations if one.type == CUBOID]


def _cuboid(where: str, one: _Annotation, classes: list[str]) -> Cuboid:
    if one.label_id is None or not 0 <= one.label_id < len(classes):
        raise InputError(f'{where}: label_id is {one.label_id} (expected 0 to {len(classes) - 1}, from "categories")')
    track = one.attributes.get("track_id")
    name, identity = classes[one.label_id], "" if track is None else str(track)
    return cuboid_of(where, name, identity, one.position, one.rotation, one.scale)


FORMAT = LabelFormat(
    'a CVAT export "Datumaro 3D" (annotations/default.json)',
    lambda path: starts_with(path, ".json", '"categories"'),
    lambda path, rig, options: read_cvat_labels(path),
)
