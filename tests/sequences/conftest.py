"""A small made-up drive, and real drives if the reference data is available."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from small_drive import CAMERAS, SIZE, image_of

FRONT_WXYZ, BACK_WXYZ = [0.5, -0.5, 0.5, -0.5], [0.5, -0.5, -0.5, 0.5]


def _calibration() -> dict:
    def camera(rotation: list[float], x: float) -> dict:
        return {
            "width": SIZE[0],
            "height": SIZE[1],
            "intrinsics": [[50.0, 0, 31.5], [0, 50.0, 17.5], [0, 0, 1]],
            "ego_from_camera": {"translation": [x, 0.0, 1.5], "rotation_wxyz": rotation},
        }

    cameras = {"CAM_FRONT": camera(FRONT_WXYZ, 1.7), "CAM_BACK": camera(BACK_WXYZ, 0.0)}
    bev = {"translation": [1, 0, 1.8], "rotation_wxyz": [0.5**0.5, 0, 0, -(0.5**0.5)]}
    return {"format": "bevcli-calibration/1", "ego_from_bev": bev, "cameras": cameras}


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Four frames with indices 10 to 13, two per second from 1 s on, of a vehicle that drives along x at 10 m/s.

    Two cameras with PNG images. The back camera is 20 ms late.
    """
    folder = tmp_path / "drive"
    for camera in CAMERAS:
        (folder / "images" / camera).mkdir(parents=True)
        for number in range(4):
            cv2.imwrite(str(folder / "images" / camera / f"{number}.png"), image_of(camera, number))
    (folder / "calibration.json").write_text(json.dumps(_calibration()))
    rows = ["frame,timestamp_ns,CAM_FRONT,CAM_BACK,CAM_BACK.timestamp_ns"]
    for number in range(4):
        time = 1_000_000_000 + number * 500_000_000
        images = f"images/CAM_FRONT/{number}.png,images/CAM_BACK/{number}.png"
        rows.append(f"{10 + number},{time},{images},{time + 20_000_000}")
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    motion = ["timestamp_ns,x,y,z,qw,qx,qy,qz"]
    motion += [f"{time},{time / 1e8},0,0,1,0,0,0" for time in range(900_000_000, 2_700_000_000, 100_000_000)]
    (folder / "ego_motion.csv").write_text("\n".join(motion) + "\n")
    return folder


@pytest.fixture
def edit(drive: Path) -> Callable[[str, str, str], Path]:
    """Replace a text in one of the drive's files. Returns the drive's folder."""

    def replace(file: str, old: str, new: str) -> Path:
        text = (drive / file).read_text()
        assert old in text
        (drive / file).write_text(text.replace(old, new, 1))
        return drive

    return replace


@pytest.fixture
def real_drive(shared: Path) -> Path:
    """The real nuScenes drive as a native folder: four keyframes, six cameras."""
    return shared / "data/nuscenes-scene-0103"


@pytest.fixture
def nuscenes_root(shared: Path) -> Path:
    """The same four keyframes as a nuScenes dataset root."""
    return shared / "data/nuscenes-mini-4"
