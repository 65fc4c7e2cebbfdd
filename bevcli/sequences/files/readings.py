"""What a file of a rig or of poses may mean: its readings, each stated by values of options."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations, product

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array

DIRECTIONS = {"f": "forward", "b": "backward", "l": "left", "r": "right", "u": "up", "d": "down"}
ALL_AXES = [
    "".join(letters) for axes in permutations(("fb", "lr", "ud")) for letters in product(*axes)
]  # of a vehicle: the directions of x, y and z
USUAL_AXES = ("flu", "frd", "rfu", "rdf")
LEFT_HANDED = ("ruf", "fru")  # of Unity and Unreal
CAMERA_AXES = {"optical": "rdf", "vehicle": "flu", "opengl": "rub", "unity": "ruf", "unreal": "fru", "ned": "frd"}
ORDERS = {order: f"quaternion {' '.join(order)}" for order in ("wxyz", "xyzw")}
ANGLES = {"vector": "rotation vectors"} | {unit: f"roll, pitch and yaw in {unit}" for unit in ("radians", "degrees")}
ANGLES |= {"clockwise": f"{ANGLES['degrees']}, clockwise", "clockwise-radians": f"{ANGLES['radians']}, clockwise"}
ANGLES |= {"unity": "yaw, pitch and roll in degrees about y, x and z"}
POSE_ANGLES = {unit: f"yaw in {unit} counter-clockwise from x" for unit in ("radians", "degrees")} | {
    "compass": "heading in degrees clockwise from north", "compass-radians": "heading in radians clockwise from north",
    "clockwise": "yaw in degrees clockwise from x", "clockwise-radians": "yaw in radians clockwise from x",
}  # fmt: skip
WORDS = {"rig_angles": ORDERS | ANGLES, "pose_angles": ORDERS | POSE_ANGLES | {"vector": ANGLES["vector"]}}


@dataclass(frozen=True)
class Reading:
    """One of the things that a file may mean."""

    states: Mapping[str, str]  # the options that state it, and their values, such as {"rig_axes": "rfu"}
    # 0 for a usual one; one of a higher rank is believed only where it fits much better
    rank: int = field(default=0, kw_only=True)

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
    """T poses, with the axes that it states; all readings share the arrays of the file."""

    translations: Array  # (T, 3) metres
    quaternions: Array  # (T, 4) w, x, y, z, norm 1
    camera: str = ""  # whose poses they are; "" for the vehicle
    note: str = ""  # how the file was read, in words


def _word(name: str, value: str) -> str:
    if name == "poses_of":
        return f"of {value}" if value != "vehicle" else "of the vehicle"
    if name in ("rig_unit", "pose_unit"):
        return f"{'translations' if name == 'rig_unit' else 'positions'} in {value}"
    if name.endswith("_axes"):
        letters = zip("xyz", CAMERA_AXES.get(value, value), strict=True)
        words = ", ".join(f"{axis} {DIRECTIONS[letter]}" for axis, letter in letters)
        return f"{'camera axes' if name == 'camera_axes' else 'axes'} {words}"
    return WORDS.get(name, {}).get(value, value)


def differing(readings: Sequence[Reading]) -> list[str]:
    """The options whose values the readings do not share."""
    names = dict.fromkeys(name for reading in readings for name in reading.states)
    return [name for name in names if len({reading.states.get(name) for reading in readings}) > 1]


MOST_NAMED = 6  # readings in a message


def question(where: object, why: str, readings: Sequence[Reading]) -> InputError:
    """The error that names readings and the options that state them. why: nothing decides between them."""
    names = differing(readings)
    choices = " or ".join(f"`{each.flags(names)}`" for each in readings[:MOST_NAMED])
    more = f" or {len(readings) - MOST_NAMED} others" if len(readings) > MOST_NAMED else ""
    options = ", ".join(f"`{name}`" for name in names)
    return InputError(f"{where}: has {len(readings)} readings, and {why}: pass {choices}{more} ({options})")
