"""T4 datasets of TIER IV, as Autoware uses them: nuScenes' tables with additions."""

from pathlib import Path

from bevcli.sequences.files.boxes_file import ClassNames
from bevcli.sequences.format import Format
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import NuScenesOptions
from bevcli.workshop.formats.nuscenes import TableDrive
from bevcli.workshop.formats.nuscenes_index import Dialect

LIDARS = ("LIDAR_CONCAT", "LIDAR_TOP")
# The documented meaning: not occluded, by less than half, by more than half, and by 90 to 100 %.
VISIBILITIES = {"full": 1.0, "most": 0.75, "partial": 0.3, "none": 0.05}

# Class names; docs/other-inputs.md says what is lost. Older datasets have the longer names. Names are compared without
# case; others stay as they are, and are not scored.
CATEGORIES_OF_CLASS = {
    "car": ("vehicle.car", "police_car", "vehicle.police", "vehicle.emergency (ambulance & police)"),
    "truck": ("ambulance", "vehicle.ambulance", "fire_truck", "vehicle.fire", "vehicle.truck"),
    "construction_vehicle": ("forklift", "vehicle.construction"),
    "bus": ("vehicle.bus", "vehicle.bus (bendy & rigid)"),
    "trailer": ("vehicle.trailer", "semi_trailer"),
    "motorcycle": ("motorbike", "vehicle.motorbike", "vehicle.motorcycle"),
    "bicycle": ("vehicle.bicycle",),
    "pedestrian": (
        "construction_worker", "police_officer", "pedestrian.adult", "pedestrian.child",
        "pedestrian.construction_worker", "pedestrian.police_officer",
    ),
    "barrier": ("movable_object.barrier",),
    "traffic_cone": ("movable_object.trafficcone", "movable_object.traffic_cone"),
}  # fmt: skip
CLASS_OF_CATEGORY = {name: class_name for class_name, names in CATEGORIES_OF_CLASS.items() for name in names}


def open_t4(path: Path, common: InputOptions, options: Format) -> TableDrive:
    """The keyframes of a T4 dataset.

    The ego frame is Autoware's base_link: below the rear axle, on the ground. The bev frame is the default, because the
    lidar's axes differ from those of nuScenes' LIDAR_TOP. Raises InputError as `TableDrive`.
    """
    names = ClassNames.of_format(CLASS_OF_CATEGORY, common.class_map)
    dialect = Dialect(LIDARS, names.__getitem__, VISIBILITIES, has_attributes=False, bev_is_lidar=False)
    return TableDrive(path, path / "annotation", common, dialect, NuScenesOptions())
