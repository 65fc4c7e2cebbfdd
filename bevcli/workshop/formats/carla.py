"""CARLA's lists of sensors, those of an agent of its leaderboard and `objects.json` of its ROS bridge.

A sensor has x, y, z in metres and roll, pitch, yaw in degrees. CARLA's axes are x forward, y right, z up, with yaw to
the right and pitch upwards; in a `spawn_point` of the ROS bridge they are those of ROS. A camera has a field of view.
"""

from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import inverse, rigid
from bevcli.sequences.files.json_fields import array_of_numbers
from bevcli.workshop.formats.autoware import NUMBERS, transform
from bevcli.workshop.formats.camera_poses import AXES

CAMERA = "sensor.camera."  # begins the type of a sensor
FOV_DEG = 90.0  # of a camera that states none


def with_sensors_by_name(document: Any, path: Path) -> Any:
    """A list of sensors as a document with K and the poses of its cameras; any other document as it is."""
    lists = document.get("objects", [document]) if isinstance(document, dict) else [{"sensors": document}]
    sensors = [
        sensor for each in lists if isinstance(each, dict) and isinstance(each.get("sensors"), list)
        for sensor in each["sensors"] if isinstance(sensor, dict) and str(sensor.get("type")).startswith(CAMERA)
    ] if isinstance(lists, list) else []  # fmt: skip
    cameras = {str(sensor.get("id", f"camera{index}")): _camera(sensor, path) for index, sensor in enumerate(sensors)}
    return {"cameras": cameras} if cameras else document


def _camera(sensor: dict[str, Any], path: Path) -> dict[str, Any]:
    place = sensor.get("spawn_point", sensor)
    size = [sensor.get(f"image_size_{axis}", sensor.get(side)) for axis, side in (("x", "width"), ("y", "height"))]
    numbers = [place.get(name, 0.0) for name in NUMBERS] if isinstance(place, dict) else []
    values = array_of_numbers([*numbers, *size, sensor.get("fov", FOV_DEG)])
    if values is None or len(values) != len(NUMBERS) + 3 or not np.isfinite(values).all() or not 0 < values[-1] < 180:
        raise InputError(
            f"{path}: camera {sensor.get('id')}: expected numbers for {', '.join(NUMBERS)}, "
            "image_size_x, image_size_y and fov"
        )
    *numbers, width, height, fov_deg = values.tolist()
    translation, angles = np.array(numbers[:3]), np.radians(numbers[3:])
    if place is sensor:  # with y to the right
        translation, angles = translation * [1, -1, 1], angles * [1, -1, -1]
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    ego_from_camera = transform(translation, angles) @ inverse(rigid(rotation=AXES["vehicle"]))
    return {
        "width": width, "height": height, "ego_from_camera": ego_from_camera.tolist(),
        "K": [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]],
    }  # fmt: skip
