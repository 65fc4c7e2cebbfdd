"""Classes of objects: how each is scored, tracked, drawn and exported. A model names its own; nuScenes has ten."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

SHOWN_SCORE = 0.25  # boxes scored below this are not shown, unless another limit is asked for
Color = tuple[int, int, int]


@dataclass(frozen=True)
class ObjectClass:
    """One class of objects."""

    name: str  # of the class
    range_m: float = 50.0  # distance from the ego vehicle on the ground below which objects are scored, metres
    gate_m: float = 4.0  # largest distance between a box and the place where its track is expected, metres
    tracked: bool = True  # whether tracks of the class are scored
    # nuScenes attribute of a moving and of a standing object; "" for a class without attributes
    attributes: tuple[str, str] = ("", "")
    # errors of the nuScenes score that the class does not have, by the devkit's names
    undefined_errors: tuple[str, ...] = ("attr_err",)
    symmetric: bool = False  # whether front and back of an object are the same
    vehicle: bool = False  # whether its objects are drawn into the map layer "vehicle"
    kitti: str = ""  # type in KITTI's label files; "" for the name
    color: Color | None = None  # RGB, 0 to 255; None for one by the index among the model's classes
    mesh: str = ""  # path of a mesh file that is drawn in the boxes of the class; "" for none


_VEHICLE = ObjectClass("", 50.0, attributes=("vehicle.moving", "vehicle.parked"), undefined_errors=(), vehicle=True)
_CYCLE = replace(_VEHICLE, range_m=40.0, attributes=("cycle.with_rider", "cycle.without_rider"))
_BUS = replace(_VEHICLE, attributes=("vehicle.moving", "vehicle.stopped"))
_WALKING = ("pedestrian.moving", "pedestrian.standing")
_BARRIER = ObjectClass("", 30.0, 1.0, False, undefined_errors=("vel_err", "attr_err"), symmetric=True)
_CONE = ObjectClass("", 30.0, 1.0, False, undefined_errors=("orient_err", "vel_err", "attr_err"))

# The ten detection classes of nuScenes, in the order of the published models' class scores. Ranges, tracked classes and
# undefined errors are those of its devkit (detection_cvpr_2019, tracking_nips_2019). A standing bus is "stopped", not
# "parked", as in the original BEVFormer. No class is red: red marks a miss or a false positive.
NUSCENES_CLASSES: Mapping[str, ObjectClass] = {
    object_class.name: object_class
    for object_class in (
        replace(_VEHICLE, name="car", gate_m=3.0, kitti="Car", color=(255, 158, 44)),
        replace(_VEHICLE, name="truck", gate_m=3.0, kitti="Truck", color=(186, 222, 92)),
        replace(
            _VEHICLE, name="construction_vehicle", tracked=False, kitti="ConstructionVehicle", color=(205, 155, 110)
        ),
        replace(_BUS, name="bus", gate_m=5.0, kitti="Bus", color=(240, 108, 190)),
        replace(_VEHICLE, name="trailer", kitti="Trailer", color=(110, 190, 120)),
        replace(_BARRIER, name="barrier", kitti="Barrier", color=(150, 160, 175)),
        replace(_CYCLE, name="motorcycle", kitti="Motorcycle", color=(178, 130, 255)),
        replace(_CYCLE, name="bicycle", gate_m=2.5, kitti="Cyclist", color=(96, 165, 255)),
        ObjectClass("pedestrian", 40.0, 2.0, True, _WALKING, (), kitti="Pedestrian", color=(70, 222, 190)),
        replace(_CONE, name="traffic_cone", kitti="TrafficCone", color=(245, 222, 90)),
    )
}
VEHICLE_CLASSES = tuple(name for name, object_class in NUSCENES_CLASSES.items() if object_class.vehicle)


@dataclass(frozen=True)
class ClassSettings:
    """The table [class_settings.NAME] of a model's TOML file: settings of one class.

    A setting that is left out is that of the class `like`; without `like`, that of the nuScenes class of the same name,
    or else the default of `ObjectClass`.

    Attributes:
        like: one of nuScenes' ten classes.
        range_m, gate_m, tracked, attributes, kitti: see `ObjectClass`.
        color: such as "#ff9e2c".
        mesh: path of a mesh file, relative to the TOML file. It changes nothing but recordings, and is a path of one
            machine: files of results and exports do not have it, and no hash depends on it.
    """

    like: str = ""
    range_m: float | None = None
    gate_m: float | None = None
    tracked: bool | None = None
    attributes: tuple[str, str] | None = None
    kitti: str | None = None
    color: str | None = None
    mesh: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.like and self.like not in NUSCENES_CLASSES:
            raise ValueError(f'like is "{self.like:.40}" (expected one of {", ".join(NUSCENES_CLASSES)})')
        if any(value is not None and not value > 0 for value in (self.range_m, self.gate_m)):
            raise ValueError("range_m and gate_m must be above 0")
        if self.color is not None and not re.fullmatch(r"#[0-9a-fA-F]{6}", self.color):
            raise ValueError(f'color is "{self.color:.40}" (expected red, green and blue such as "#ff9e2c")')

    def resolve(self, name: str) -> ObjectClass:
        """The class of this name with these settings."""
        base = NUSCENES_CLASSES.get(self.like or name, ObjectClass(name))
        keys = ("range_m", "gate_m", "tracked", "attributes", "kitti", "mesh")
        changes: dict[str, Any] = {key: getattr(self, key) for key in keys if getattr(self, key) is not None}
        if self.attributes is not None:
            changes["undefined_errors"] = () if any(self.attributes) else (*base.undefined_errors, "attr_err")
        if self.color is not None:
            changes["color"] = color_of_hex(self.color)
        return replace(base, name=name, **changes)


def color_of_hex(text: str) -> Color:
    """The colour of a text such as "#ff9e2c"."""
    red, green, blue = bytes.fromhex(text[1:])
    return red, green, blue


def hex_of_color(color: Color) -> str:
    """The text of a colour."""
    return f"#{bytes(color).hex()}"


def object_classes(names: Iterable[str], settings: Mapping[str, ClassSettings]) -> dict[str, ObjectClass]:
    """Classes by name, in the order of the names. Raises ValueError for no or a repeated name, or settings of no class.

    Classes that are drawn like the same nuScenes class have its colour only once: the others take one by their index.
    """
    class_names = tuple(names)
    if not class_names:
        raise ValueError("classes is empty (expected at least one name)")
    for name in class_names:
        if not (name.strip() == name and 0 < len(name) <= 100 and name.isprintable()):
            raise ValueError(f"classes: {name!r:.60} is not a name (expected up to 100 printable characters)")
        if class_names.count(name) > 1:
            raise ValueError(f'classes: "{name}" stands there twice')
    unknown = settings.keys() - set(class_names)
    if unknown:
        raise ValueError(f'class_settings: "{min(unknown)}" is not among the classes ({", ".join(class_names)})')
    made: dict[str, ObjectClass] = {}
    for name in class_names:
        resolved = settings.get(name, ClassSettings()).resolve(name)
        taken = any(other.color == resolved.color for other in made.values())
        has_color = name in settings and settings[name].color is not None
        made[name] = replace(resolved, color=None) if taken and not has_color else resolved
    return made


def are_nuscenes(classes: Mapping[str, ObjectClass]) -> bool:
    """True for the ten classes with nuScenes' own settings: scores are then comparable to nuScenes'."""
    return {name: _scoring(object_class) for name, object_class in classes.items()} == {
        name: _scoring(object_class) for name, object_class in NUSCENES_CLASSES.items()
    }


def _scoring(object_class: ObjectClass) -> ObjectClass:
    """The class without what changes no score."""
    return replace(object_class, color=None, kitti="", gate_m=1.0, mesh="")
