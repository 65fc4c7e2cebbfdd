"""Drives of KITTI as they lie on disk, odometry (`sequences/00`) and raw (`2011_09_26/2011_09_26_drive_0001_sync`).

Calibration, times and poses are found where the data set has them; options replace them.
"""

from dataclasses import replace
from pathlib import Path

from bevcli.errors import InputError
from bevcli.parsing.files import is_there
from bevcli.sequences.native import FolderOptions
from bevcli.sequences.native.folder import FolderDrive
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats.other_calibrations import KITTI_FILES


def open_kitti(path: Path, common: InputOptions, options: FolderOptions) -> FolderDrive:
    """A drive of KITTI as a `Drive`. Raises InputError."""
    files = [folder / name for folder in (path, path.resolve().parent) for name in KITTI_FILES]
    if options.calibration is None and options.intrinsics is None and options.fov_deg is None:
        calibration = next((file for file in files if is_there(file)), None)
        if calibration is None:
            raise InputError(
                f"{path}: has no calibration (expected calib.txt, or calib_cam_to_cam.txt in the folder above): add "
                "it, or pass `calibration` (`--calibration FILE`)"
            )
        options = replace(options, calibration=calibration)
    if options.ego_motion_file is None:
        drive = path.resolve()
        beside = drive.parent.parent / f"poses/{drive.name}.txt"
        poses = (path / "poses.txt", path / f"{drive.name}.txt", beside, path / "oxts")
        options = replace(options, ego_motion_file=next((file for file in poses if is_there(file)), None))
    return FolderDrive(path, common, options)
