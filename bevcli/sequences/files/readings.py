"""What a file of a rig or of poses may mean: its readings, each stated by values of options."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array

AXES = {
    "flu": "axes x forward, y left, z up",
    "frd": "axes x forward, y right, z down",
    "rfu": "axes x right, y forward, z up",
    "rdf": "axes x right, y down, z forward",
}
CAMERA_AXES = {
    "optical": "camera axes x right, y down, z forward",
    "vehicle": "camera axes x forward, y left, z up",
    "opengl": "camera axes x right, y up, z backward",
}
ORDERS = {order: f"quaternion {' '.join(order)}" for order in ("wxyz", "xyzw")}
ANGLES = {"vector": "rotation vectors"} | {unit: f"roll, pitch and yaw in {unit}" for unit in ("radians", "degrees")}
POSE_ANGLES = {unit: f"yaw in {unit} counter-clockwise from x" for unit in ("radians", "degrees")} | {
    "compass": "heading in degrees clockwise from north", "compass-radians": "heading in radians clockwise from north",
}  # fmt: skip
WORDS = {
    "rig_axes": AXES, "pose_axes": AXES, "camera_axes": CAMERA_AXES, "rig_angles": ORDERS | ANGLES,
    "pose_angles": ORDERS | POSE_ANGLES,
}  # fmt: skip


@dataclass(frozen=True)
class Reading:
    """One of the things that a file may mean.

    Attributes:
        states: the options that state it, and their values, such as {"rig_axes": "rfu"}.
    """

    states: Mapping[str, str]

    def words(self, names: Sequence[str] = ()) -> str:
        """It in words. names: the options of interest; all by default."""
        words = (_word(name, value) for name, value in self.states.items() if not names or name in names)
        return ", ".join(word for word in words if word)

    def flags(self, names: Sequence[str]) -> str:
        """The flags that state it."""
        return " ".join(f"--{name.replace('_', '-')} {self.states[name]}" for name in names if name in self.states)


@dataclass(frozen=True)
class RigReading(Reading):
    """ego_from_camera (4, 4) by camera, with optical axes, metres."""

    ego_from_camera: Mapping[str, Array]


@dataclass(frozen=True)
class PoseReading(Reading):
    """T poses world_from_ego, or those of a camera.

    Attributes:
        translations: (T, 3) metres.
        quaternions: (T, 4) w, x, y, z, norm 1.
        camera: whose poses they are, with optical axes; "" for the vehicle.
        note: how the file was read, in words.
    """

    translations: Array
    quaternions: Array
    camera: str = ""
    note: str = ""


def _word(name: str, value: str) -> str:
    if name == "poses_of":
        return f"of {value}" if value != "vehicle" else "of the vehicle"
    if name == "rig_unit":
        return f"translations in {value}"
    return WORDS.get(name, {}).get(value, value)


def differing(readings: Sequence[Reading]) -> list[str]:
    """The options whose values the readings do not share."""
    names = dict.fromkeys(name for reading in readings for name in reading.states)
    return [name for name in names if len({reading.states.get(name) for reading in readings}) > 1]


MOST_NAMED = 6  # readings in a message


def question(where: object, why: str, readings: Sequence[Reading], alike: Sequence[Reading] = ()) -> InputError:
    """The error that names readings and the options that state them. why: nothing decides between them.

    alike: others that mean the same as one of them.
    """
    names = differing([*readings, *alike])
    choices = " or ".join(f"`{each.flags(names)}`" for each in readings[:MOST_NAMED])
    more = f" or {len(readings) - MOST_NAMED} others" if len(readings) > MOST_NAMED else ""
    options = ", ".join(f"`{name}`" for name in names)
    return InputError(f"{where}: has {len(readings)} readings, and {why}: pass {choices}{more} ({options})")
