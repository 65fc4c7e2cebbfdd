"""The 3D boxes of a DGP scene."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, yaw_of_rotation
from bevcli.sequences.dgp.classes import CLASS_OF_NAME
from bevcli.sequences.dgp.records import BOXES_3D, Record, read_record
from bevcli.sequences.files.class_names import ClassNames

SIZE = ("length", "width", "height")


def read_ontology(folder: Path, scene: Record, class_map: Mapping[str, str]) -> dict[int, str]:
    """The class of each `class_id` of 3D boxes. Raises InputError. folder: of the scene."""
    names = ClassNames.of_format(CLASS_OF_NAME, class_map)
    items = read_record(folder / "ontology" / f"{scene.record('ontologies').text(BOXES_3D)}.json").records("items")
    return {item.integer("id", 0): names[item.text("name")] for item in items}


def read_boxes(path: Path, world_from_sensor: Array, classes: Mapping[int, str]) -> Boxes3D:
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
