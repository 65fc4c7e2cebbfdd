"""ORB-SLAM's files of settings, whose names state the camera: Camera.fx, or Camera1.fx and Camera2.fx of two."""

import re
from typing import Any

import numpy as np

from bevcli.geometry.transforms import inverse
from bevcli.sequences.files.json_fields import array_of_numbers

CAMERA = re.compile(r"Camera(\d*)\.(.+)")
LENSES = {"kannalabrandt8": "fisheye", "kannalabrandt": "fisheye"}  # by Camera.type; others are pinhole cameras


def with_cameras_apart(document: dict[Any, Any]) -> dict[str, Any]:
    """A document with the values of each camera together: those of one at the top, those of two as `cameras`."""
    numbers = {match[1] for key in document if (match := CAMERA.fullmatch(str(key)))} - {""}
    if len(numbers) < 2:
        return {re.sub(r"\ACamera\d*\.", "", str(key)): value for key, value in document.items()}
    cameras: dict[str, dict[str, Any]] = {number: {} for number in sorted(numbers)}
    for key, value in document.items():
        if (match := CAMERA.fullmatch(str(key))) is not None:
            for number in [match[1]] if match[1] else cameras:
                cameras[number][match[2]] = value
    for camera in cameras.values():
        camera["camera_model"] = LENSES.get(str(camera.pop("type", "")).lower(), "pinhole")
    pose = document.get("IMU.T_b_c1", document.get("Tbc"))
    if pose is not None and "1" in cameras:
        cameras["1"]["T_body_camera"] = pose
    stereo = document.get("Stereo.T_c1_c2")
    matrix = array_of_numbers(stereo.get("data") if isinstance(stereo, dict) else stereo)
    if matrix is not None and matrix.size == 16 and "2" in cameras:
        cameras["2"]["T_cn_cnm1"] = inverse(np.reshape(matrix, (4, 4))).tolist()
    return {"cameras": {f"Camera{number}": camera for number, camera in cameras.items()}}
