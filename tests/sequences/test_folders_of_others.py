"""Folders as other programs and data sets lay them out on disk."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from bevcli.errors import InputError
from bevcli.geometry.transforms import GeoOrigin, rigid, rotation_about_z
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
    how = {"calibration": kalibr_of(tmp_path, 6), "image_rate_hz": 2, "ego_motion": "static", "rig_axes": "flu"}
    sequence = open_sequence(drive, **how)
    assert sequence.rig.names == ("cam0", "cam3")
    assert "without images, left out: cam1, cam2, cam4, cam5" in " ".join(sequence.notes)
    shutil.copytree(drive / "cam0", drive / "cam8")
    with pytest.raises(InputError, match=r"cam1: the image size is missing.*or name the folder of its images cam1"):
        open_sequence(drive, **how)
    (drive / "cam8").rename(drive / "cam1")
    assert open_sequence(drive, **how).rig.names == ("cam0", "cam1", "cam3")


@pytest.mark.parametrize("axes", ["flu", "rfu"])
def test_a_rig_that_stands_is_alike_on_both_sides(tmp_path, axes):
    """One image of cameras whose names say no direction: the axes are those with the same cameras left and right."""
    drive, path = images_of(tmp_path / "drive", "cam0", "cam3", count=1), kalibr_of(tmp_path, 6)
    if axes == "rfu":
        cameras = yaml.safe_load(path.read_text())
        for camera in cameras.values():
            turned = np.eye(4)
            turned[:2, :2] = [[0, 1], [-1, 0]]
            camera["T_cam_imu"] = (np.array(camera["T_cam_imu"]) @ turned).tolist()
        path.write_text(yaml.safe_dump(cameras))
    how = {"calibration": path, "image_rate_hz": 2, "ego_motion": "static"}
    sequence = open_sequence(drive, **how)
    for name, own in (("cam0", "CAM_FRONT"), ("cam3", "CAM_BACK")):
        stated = FACTS[own]["ego_from_camera"]
        np.testing.assert_allclose(sequence.rig[name].ego_from_camera[:3, :3], stated["rotation"], atol=1e-6)
        np.testing.assert_allclose(sequence.rig[name].ego_from_camera[:3, 3], stated["translation"], atol=1e-6)
    other = {"flu": "rfu", "rfu": "flu"}[axes]
    assert f"6 of 6 cameras are alike on both sides, with --rig-axes {other} 0" in " ".join(sequence.notes)
    turned = open_sequence(drive, **how, rig_axes=other).rig["cam0"].yaw
    assert turned == pytest.approx(-np.pi / 2 if axes == "flu" else np.pi / 2)
    with pytest.raises(InputError, match="the images are not compared: pass `--rig-axes"):
        open_sequence(drive, **how, image_check=False)


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
    place = FACTS["CAM_BACK"]["ego_from_camera"]["translation"]
    np.testing.assert_allclose(rig["CAM_BACK"].ego_from_camera[:3, 3], place)


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


# KITTI. The vehicle drives along x at 10 m/s and turns left; the Velodyne is 0.76 m ahead and 1.73 m up.
K = np.array([[633.0, 0, 400], [0, 633, 225], [0, 0, 1]])
CAMERA_FROM_VELODYNE = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
VELODYNE_FROM_IMU = np.array([[1.0, 0, 0, -0.81], [0, 1, 0, 0.32], [0, 0, 1, -0.8], [0, 0, 0, 1]])
EGO_FROM_VELODYNE = np.array([[1.0, 0, 0, 0.76], [0, 1, 0, 0], [0, 0, 1, 1.73], [0, 0, 0, 1]])
BASELINES = {0: 0.0, 1: -0.54, 2: 0.06, 3: -0.48}  # of the cameras, from camera 0 to the left


def world_from_ego(index: int) -> np.ndarray:
    return rigid((5.0 * index, 0.05 * index**2, 0), rotation_about_z(0.02 * index))


def rows(**matrices: np.ndarray) -> str:
    return "".join(f"{name}: {' '.join(f'{value:.12e}' for value in np.ravel(of))}\n" for name, of in matrices.items())


def kitti_odometry(root: Path, poses: str) -> Path:
    drive = images_of(root / "sequences/07", "image_2", "image_3")
    projections = {f"P{key}": K @ np.c_[np.eye(3), [x, 0, 0]] for key, x in BASELINES.items()}
    (drive / "calib.txt").write_text(rows(**projections, Tr=CAMERA_FROM_VELODYNE[:3]))
    (drive / "times.txt").write_text("".join(f"{0.5 * index:e}\n" for index in range(4)))
    camera0_from_ego = CAMERA_FROM_VELODYNE @ np.linalg.inv(EGO_FROM_VELODYNE)
    start = np.linalg.inv(camera0_from_ego @ np.linalg.inv(world_from_ego(0)))
    lines = [np.linalg.inv(start) @ world_from_ego(n) @ np.linalg.inv(camera0_from_ego) for n in range(4)]
    (root / poses).parent.mkdir(exist_ok=True, parents=True)
    (root / poses).write_text("".join(" ".join(f"{value:.9e}" for value in line[:3].ravel()) + "\n" for line in lines))
    return drive


def kitti_raw(root: Path) -> Path:
    day = root / "2011_09_26"
    drive = images_of(day / "2011_09_26_drive_0001_sync", "image_02/data", "image_03/data", "oxts/data")
    for file in (drive / "oxts/data").iterdir():
        file.unlink()
    stamps = "".join(f"2011-09-26 13:02:{25 + index / 2:012.9f}\n" for index in range(4))
    for folder in ("image_02", "image_03", "oxts"):
        (drive / folder / "timestamps.txt").write_text(stamps)
    sizes = {f"S_rect_0{key}": np.array([800.0, 450]) for key in BASELINES}
    projections = {f"P_rect_0{key}": K @ np.c_[np.eye(3), [x, 0, 0]] for key, x in BASELINES.items()}
    text = rows(**sizes, R_rect_00=np.eye(3), **projections)
    (day / "calib_cam_to_cam.txt").write_text(f"calib_time: 09-Jan-2012 13:57:47\n{text}")
    for name, matrix in (("velo_to_cam", CAMERA_FROM_VELODYNE), ("imu_to_velo", VELODYNE_FROM_IMU)):
        (day / f"calib_{name}.txt").write_text(rows(R=matrix[:3, :3], T=matrix[:3, 3]))
    ego_from_imu = EGO_FROM_VELODYNE @ VELODYNE_FROM_IMU
    for index in range(4):
        pose = world_from_ego(index) @ ego_from_imu
        place = GeoOrigin(49.0, 8.4).latitude_longitude(pose[:2, 3])
        numbers = [*place, 110 + pose[2, 3], 0, 0, np.arctan2(pose[1, 0], pose[0, 0]), *[0] * 24]
        (drive / f"oxts/data/{index:010d}.txt").write_text(" ".join(f"{number:.12f}" for number in numbers))
    return drive


LATER = (pytest.param(f"sequences/07/{name}.txt", marks=pytest.mark.slow) for name in ("poses", "07"))


@pytest.mark.parametrize("layout", ["raw", "poses/07.txt", *LATER])
def test_kitti_as_it_lies_on_disk(tmp_path, layout):
    drive = kitti_raw(tmp_path) if layout == "raw" else kitti_odometry(tmp_path, layout)
    sequence = open_sequence(drive, image_check=False)  # its images are of another drive
    names = ("image_02", "image_03") if layout == "raw" else ("image_2", "image_3")
    assert sequence.rig.names == names
    for name in names:
        pose = sequence.rig[name].ego_from_camera
        np.testing.assert_allclose(pose[:3, 3], [1.03, BASELINES[int(name[-1])], 1.65], atol=1e-6)
        np.testing.assert_allclose(pose[:3, 2], [1, 0, 0], atol=1e-6)
    times = [stamp.timestamp_ns - sequence.stamps[0].timestamp_ns for stamp in sequence.stamps]
    assert times == [0, 500_000_000, 1_000_000_000, 1_500_000_000]
    assert layout != "raw" or sequence.stamps[0].timestamp_ns == 1_317_042_145_000_000_000
    poses = [sequence.load(index).world_from_ego.matrix for index in range(4)]
    for index in range(1, 4):
        found = np.linalg.inv(poses[0]) @ poses[index]
        np.testing.assert_allclose(found, np.linalg.inv(world_from_ego(0)) @ world_from_ego(index), atol=5e-3)
    assert not any("assumed" in note and "Hz" in note for note in sequence.notes)


def test_a_mistake_in_a_drive_of_kitti_is_one_line(tmp_path):
    drive = kitti_raw(tmp_path)
    (drive / "oxts/data/0000000002.txt").write_text("1 2 3")
    with pytest.raises(InputError, match=r"0000000002.txt: expected 30 finite numbers"):
        open_sequence(drive)
    (drive / "oxts/data/0000000002.txt").unlink()
    with pytest.raises(InputError, match=r"oxts: has 4 times and 3 files in data"):
        open_sequence(drive)
    (drive.parent / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(InputError, match=r"has no calibration \(expected calib.txt, or calib_cam_to_cam.txt"):
        open_sequence(drive)
    yaws = {"image_02": 0, "image_03": 0}
    assert open_sequence(drive, fov_deg=65, height=1.65, yaw_deg=yaws, ego_motion="static").rig
