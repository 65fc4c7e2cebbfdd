"""Folders as other programs and data sets lay them out on disk."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from bevcli.errors import InputError
from bevcli.sequences.open import open_sequence

STREET = Path(__file__).parents[2] / "samples/street"
FACTS = json.loads((STREET / "calibration.json").read_text())["cameras"]


def images_of(folder: Path, *names: str, count: int = 4) -> Path:
    """Images of the cameras of the street, each in a folder of its own, numbered."""
    for name in names:
        (folder / name).mkdir(parents=True)
        for index in range(count):
            shutil.copy(STREET / f"images/{'CAM_FRONT'}/{index:06d}.jpg", folder / name / f"{index:06d}.jpg")
    return folder


def kalibr_of(folder: Path, count: int) -> Path:
    cameras = {}
    for index, facts in enumerate(list(FACTS.values())[:count]):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = facts["ego_from_camera"]["rotation"], facts["ego_from_camera"]["translation"]
        k = np.array(facts["intrinsics"])
        cameras[f"cam{index}"] = {
            "T_cam_imu": np.linalg.inv(pose).tolist(), "camera_model": "pinhole", "distortion_coeffs": [0, 0, 0, 0],
            "distortion_model": "radtan", "intrinsics": k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
        }  # fmt: skip
    (folder / "camchain.yaml").write_text(yaml.safe_dump(cameras))
    return folder / "camchain.yaml"


def test_cameras_without_images_are_left_out_with_a_note(tmp_path):
    drive = images_of(tmp_path / "drive", "cam0", "cam3")
    sequence = open_sequence(drive, calibration=kalibr_of(tmp_path, 6), image_rate_hz=2, ego_motion="static")
    assert sequence.rig.names == ("cam0", "cam3")
    assert "without images, left out: cam1, cam2, cam4, cam5" in " ".join(sequence.notes)
    shutil.copytree(drive / "cam0", drive / "cam8")
    how = {"calibration": tmp_path / "camchain.yaml", "image_rate_hz": 2, "ego_motion": "static"}
    with pytest.raises(InputError, match=r"cam1: the image size is missing.*or name the folder of its images cam1"):
        open_sequence(drive, **how)
    (drive / "cam8").rename(drive / "cam1")
    assert open_sequence(drive, **how).rig.names == ("cam0", "cam1", "cam3")


def test_a_sequence_folder_may_have_images_of_some_cameras(tmp_path):
    images_of(tmp_path / "images", "CAM_FRONT", "CAM_BACK")
    shutil.copy(STREET / "calibration.json", tmp_path)
    sequence = open_sequence(tmp_path, image_rate_hz=2, ego_motion="static")
    assert sequence.rig.names == ("CAM_FRONT", "CAM_BACK")
    assert any(note.startswith("without images, left out: CAM_FRONT_RIGHT, ") for note in sequence.notes)


def test_a_list_of_cameras_in_json(tmp_path):
    cameras = [{"name": name, **{key: value for key, value in facts.items() if key != "distortion"}}
               for name, facts in FACTS.items()]  # fmt: skip
    (tmp_path / "rig.json").write_text(json.dumps(cameras))
    drive = images_of(tmp_path / "drive", *FACTS)
    rig = open_sequence(drive, calibration=tmp_path / "rig.json", image_rate_hz=2, ego_motion="static").rig
    assert rig.names == tuple(FACTS)
    np.testing.assert_allclose(
        rig["CAM_BACK"].ego_from_camera[:3, 3], FACTS["CAM_BACK"]["ego_from_camera"]["translation"]
    )


def test_the_time_of_the_first_image_may_be_stated_for_any_times(tmp_path):
    """A computer without a clock wrote the poses: the advice of the error is followed."""
    drive = images_of(tmp_path, "CAM_FRONT", count=4)
    for index, path in enumerate(sorted((drive / "CAM_FRONT").iterdir())):
        path.rename(path.with_name(f"{1_700_000_000 + index / 2:.1f}.jpg"))
    poses = "\n".join(f"{1.1 + index / 10:.1f} {index / 5} 0 0 0 0 0 1" for index in range(40))
    (tmp_path / "poses.txt").write_text(poses)
    how = {"fov_deg": 65, "height": 1.5, "ego_motion_file": tmp_path / "poses.txt"}
    with pytest.raises(InputError, match=r"state the time of the first image by `start_ns` \(`--start-ns`\)"):
        open_sequence(drive, **how)
    sequence = open_sequence(drive, **how, start_ns=1_200_000_000)
    assert [stamp.timestamp_ns for stamp in sequence.stamps[:2]] == [1_200_000_000, 1_700_000_000]
    assert "seconds since 1970, moved so that the first is 1200000000 ns" in " ".join(sequence.notes)
