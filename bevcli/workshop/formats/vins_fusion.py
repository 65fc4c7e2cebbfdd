"""VINS-Fusion's configuration: poses of the cameras in one file (`body_T_cam0`), K and D in those that it names.

Each `cam0_calib` names a file beside it, of a lens of camodocal.
"""

import re
from pathlib import Path
from typing import Any

from bevcli.errors import InputError
from bevcli.parsing.files import read_bytes
from bevcli.workshop.formats.camera_poses import Cameras
from bevcli.workshop.formats.markup import YAML_BYTES, read_yaml
from bevcli.workshop.formats.named_calibration import cameras_of, files_in

CALIBRATION = re.compile(r"cam(\d+)_calib")
LINE = re.compile(rb"^cam\d+_calib\s*:", re.MULTILINE)
# The lens KANNALA_BRANDT of camodocal, and the names here.
KANNALA_BRANDT = {"mu": "fx", "mv": "fy", "u0": "cx", "v0": "cy", "k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4"}


def main_files(path: Path) -> list[Path]:
    """The file of VINS-Fusion that names others, or all of a folder; none for another calibration."""
    files = [path] if path.is_file() else files_in(path)
    files = [file for file in files if file.suffix.lower() in (".yaml", ".yml")]
    return [file for file in files if LINE.search(read_bytes(file, YAML_BYTES))]


def read_vins_fusion(path: Path) -> Cameras:
    """The cameras cam0, cam1 of VINS-Fusion. Of several files in a folder, that with most cameras is taken."""
    rigs = [_cameras(file) for file in main_files(path)]
    most = max(map(len, rigs))
    rig, *others = [rig for rig in rigs if len(rig) == most]
    if any(other != rig for other in others):
        names = ", ".join(file.name for file in main_files(path))
        raise InputError(f"{path}: has several configurations ({names}): pass one of these files")
    return cameras_of(rig, path)


def _cameras(main: Path) -> dict[str, Any]:
    document, cameras = read_yaml(main), dict[str, Any]()
    if not isinstance(document, dict):
        raise InputError(f"{main}: is no mapping (expected cam0_calib, body_T_cam0 and so on)")
    for key, name in document.items():
        if (match := CALIBRATION.fullmatch(str(key))) is not None:
            camera = read_yaml(main.parent / Path(str(name)).name)
            if not isinstance(camera, dict):
                raise InputError(f"{main}: {key}: {name}: is no mapping (expected K and D of a camera)")
            pose = f"body_T_cam{match[1]}"
            stated = {pose: document[pose]} if pose in document else {}
            cameras[f"cam{match[1]}"] = {**_in_own_names(camera), **stated}
    return cameras


def _in_own_names(camera: dict[str, Any]) -> dict[str, Any]:
    numbers = camera.get("projection_parameters")
    if str(camera.get("model_type")).upper() != "KANNALA_BRANDT" or not isinstance(numbers, dict):
        return camera
    renamed = {new: numbers.get(name) for name, new in KANNALA_BRANDT.items()}
    return {**camera, "projection_parameters": None, **renamed}
