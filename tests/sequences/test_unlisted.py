"""Folders of images as they lie on disk, without frames.csv, and as other programs and data sets lay them out."""

import json
import random
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import yaml

from bevcli.errors import InputError
from bevcli.geometry.transforms import GeoOrigin, rigid, rotation_about_z
from bevcli.sequences.native.folder import FolderDrive
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats.matching import match_names

START_S = 1_772_366_400  # 2026-03-01 12:00:00 in UTC


def images(drive: Path, names: dict[str, list[str]], inside: str = "images") -> Path:
    """Replace the images of the small drive by others, which are not opened. names: by folder, without suffix."""
    for path in (*drive.rglob("*.png"), drive / "frames.csv"):
        path.unlink()
    for folder in (*(drive / "images").iterdir(), drive / "images"):
        folder.rmdir()
    for folder, stems in names.items():
        (drive / inside / folder).mkdir(parents=True)
        for stem in stems:
            (drive / inside / folder / f"{stem}.jpg").touch()
    return drive


def both(names: list[str]) -> dict[str, list[str]]:
    """The same names for both cameras."""
    return {"CAM_FRONT": names, "CAM_BACK": names}


def opened(drive: Path, names: list[str], **options):
    """The small drive with both cameras' images under these names, standing still, and the line about them."""
    sequence = open_sequence(images(drive, both(names)), ego_motion="static", **options)
    return sequence, next(note for note in sequence.notes if "frames.csv is missing" in note)


def seconds(sequence) -> list[float]:
    """Times of the frames after the first, seconds."""
    return [(stamp.timestamp_ns - sequence.stamps[0].timestamp_ns) / 1e9 for stamp in sequence.stamps]


def jittered(rate: float, seed: int, count: int = 40, jitter_s: float = 0.004) -> list[float]:
    generator = random.Random(seed)
    return [n / rate + generator.uniform(-jitter_s, jitter_s) for n in range(count)]


def poses(drive: Path, start_s: float, count: int = 400) -> None:
    """Poses at 100 Hz from a time on, of a vehicle at 10 m/s."""
    times = [round(start_s * 1e9) + n * 10_000_000 for n in range(count)]
    rows = [f"{time},{n / 10},0,0,1,0,0,0" for n, time in enumerate(times)]
    (drive / "ego_motion.csv").write_text("\n".join(["timestamp_ns,x,y,z,qw,qx,qy,qz", *rows]))


DATES = [datetime(2026, 3, 1, 12, tzinfo=UTC) + timedelta(seconds=n / 12) for n in range(40)]
WAYS = {  # names, hertz, what the line says, start in seconds or None
    "seconds": ([str(START_S + n) for n in range(40)], 1, "seconds since 1970", START_S),
    "decimals": ([f"{START_S + n / 12:.6f}" for n in range(40)], 12, "seconds since 1970", START_S),
    "decimals of any length": ([str(START_S + n / 8) for n in range(40)], 8, "seconds since 1970", START_S),
    "decimals since boot": ([f"{312.5 + n / 12:.4f}" for n in range(40)], 12, "seconds", 312.5),
    "seconds and nanoseconds": ([f"{START_S + n // 4}_{n % 4 * 250000000:09d}" for n in range(40)], 4,
                                "seconds since 1970", START_S),
    "milliseconds": ([f"img_{START_S * 1000 + n * 100}" for n in range(40)], 10, "milliseconds since 1970", START_S),
    "microseconds": ([f"CAM_{START_S * 10**6 + n * 10**5}" for n in range(40)], 10, "microseconds since 1970", START_S),
    "nanoseconds": ([f"{START_S * 10**9 + n * 5 * 10**8}" for n in range(40)], 2, "nanoseconds since 1970", START_S),
    "microseconds since boot": ([f"{5_312_000 + n * 83_333}" for n in range(40)], 12, "microseconds", 5.312),
    "nanoseconds since boot": ([f"{10**12 + n * 33_333_333}" for n in range(40)], 30, "nanoseconds", 1000),
    "milliseconds with steps of 500": ([f"{n * 500:07d}" for n in range(40)], 2, "milliseconds", 0),
    "nuscenes": ([f"n015-2018-07-24-11-22-45+0800__{START_S * 10**6 + n * 83_333}" for n in range(40)], 12,
                 "microseconds since 1970", START_S),
    "a counter and a time": ([f"{START_S * 10**6 + n * 10**5}_{n:04d}" for n in range(40)], 10,
                             "microseconds since 1970", START_S),
    "dates": ([f"{20260301120000 + n}" for n in range(40)], 1, "dates in UTC", START_S),
    "dates with fractions": ([f"{each:%Y-%m-%d_%H-%M-%S.%f}" for each in DATES], 12, "dates in UTC", START_S),
    "dates and milliseconds": ([f"{each:%Y%m%d%H%M%S%f}"[:-3] for each in DATES], 12, "dates in UTC", START_S),
    "counters": ([f"fl_{n:04d}" for n in range(40)], 2, "at 2 Hz (assumed", 0),
    "some of the images": (["3", "17", "40", "51", "90", "95"], None, "at 2 Hz (assumed", 0),
    "a date of the drive and counters": ([f"20260301_120000_{n:05d}" for n in range(40)], 2, "at 2 Hz (assumed", 0),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_the_unit_of_names_is_found(drive, way):
    names, rate, said, start = WAYS[way]
    sequence, line = opened(drive, names)
    assert said in line
    assert len(sequence.stamps) == len(names)
    if rate is not None:
        np.testing.assert_allclose(seconds(sequence), np.arange(len(names)) / rate, atol=2e-3)
    np.testing.assert_allclose(sequence.stamps[0].timestamp_ns / 1e9, start, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_milliseconds_with_jitter_are_no_indices(drive, seed):
    """40 images at 30 Hz, up to 4 ms early or late, of which some are lost."""
    times = [time for n, time in enumerate(jittered(30, seed)) if n % 9 != 8]
    sequence, line = opened(drive, [f"{round(time * 1000) + 4000:06d}" for time in times])
    assert "times are milliseconds, 2 cameras at" in line
    np.testing.assert_allclose(seconds(sequence), np.array(times) - times[0], atol=1.1e-3)


def test_two_possible_readings_need_the_option(drive):
    """0, 100, 200, … are milliseconds at 10 Hz, or every hundredth image."""
    names = [f"{n * 100:06d}" for n in range(20)]
    with pytest.raises(
        InputError,
        match=r'milliseconds \(10 Hz\) or indices of images: pass `times="ms"` .* or `times="index"`',
    ):
        opened(drive, names)
    standing = {"ego_motion": "static"}
    assert seconds(open_sequence(drive, times="ms", **standing))[:3] == [0, 0.1, 0.2]
    assert seconds(open_sequence(drive, times="index", image_rate_hz=500, **standing))[:3] == [0, 0.2, 0.4]
    (drive / "timing.toml").write_text('times = "ms"\nstart_ns = 5000000000\n')
    assert open_sequence(drive, **standing).stamps[1].timestamp_ns == 5_100_000_000


def test_seconds_since_1970_may_be_milliseconds(drive):
    """Images every 10 s by their Unix time, or at 100 Hz on a computer that was started 20 days ago."""
    with pytest.raises(InputError, match=r"seconds since 1970 \(0.1 Hz\) or milliseconds \(100 Hz\): pass `times"):
        opened(drive, [str(1_700_000_000 + 10 * n) for n in range(20)])
    assert seconds(open_sequence(drive, times="s", ego_motion="static"))[1] == 10


def test_the_poses_decide_between_two_readings(drive):
    poses(drive, 0)
    images(drive, both([f"{n * 100:06d}" for n in range(20)]))
    assert seconds(open_sequence(drive))[:3] == [0, 0.1, 0.2]
    poses(drive, 5000)
    with pytest.raises(InputError, match=r"numbered 0 to 1900, and the poses cover 4.0 s.*`image_rate_hz`.*`start_ns`"):
        open_sequence(drive)
    poses(drive, 5000, count=1901)
    sequence = open_sequence(drive)
    assert any("with the times of the 1901 poses (100.0 Hz)" in note for note in sequence.notes)
    assert seconds(sequence)[:3] == [0, 1, 2]


def test_numbered_images_with_poses_without_times_need_a_rate(drive):
    (drive / "ego_motion.csv").unlink()
    (drive / "kitti.txt").write_text("\n".join(f"1 0 0 {n} 0 1 0 0 0 0 1 0" for n in range(5)))
    images(drive, both([f"{n:06d}" for n in range(5)]))
    poses_of = {"ego_motion_file": drive / "kitti.txt", "poses_of": "vehicle"}
    with pytest.raises(InputError, match=r"numbered 0 to 4, and there are poses: state .* by `image_rate_hz`"):
        open_sequence(drive, **poses_of)
    assert seconds(open_sequence(drive, image_rate_hz=10, **poses_of)) == [0, 0.1, 0.2, 0.3, 0.4]


def test_local_dates_are_moved_to_the_time_of_the_poses(drive):
    """The clock of the images shows 14:00 where the poses, since 1970, begin at 12:00 in UTC."""
    poses(drive, START_S)
    sequence = open_sequence(images(drive, both(["20260301140001", "20260301140002"])))
    assert sequence.stamps[0].timestamp_ns == (START_S + 1) * 10**9
    assert any("dates in UTC+2" in note for note in sequence.notes)


def test_frames_before_the_first_pose_are_left_out(drive):
    poses(drive, START_S + 0.5)
    names = [str(round((START_S + n / 10) * 1e6)) for n in range(20)]
    sequence = open_sequence(images(drive, both(names)))
    assert len(sequence.stamps) == 15
    assert any("5 frames outside of the poses left out" in note for note in sequence.notes)


@pytest.mark.parametrize(
    ("names", "options", "expected"),
    [
        ([f"{10**14 + n * 250 * 10**9}" for n in range(5)], {}, r"no times of a camera in any unit.*`times`"),
        (["a_1", "a_2", "a_3_4"], {}, r"a_3_4 has 2 numbers, and a_1 has 1: rename"),
        ([f"{START_S}{n}00000" for n in range(5)], {"times": "ms"}, r"expected milliseconds, different"),
        (["1", "2", "3"], {"image_rate_hz": 1e-300}, r"expected images per second, 0.001 or more"),
        (["1", "2", "3"], {"start_ns": 10**30}, r"expected nanoseconds, at most"),
        (["1", "2", "3"], {"times": "date"}, r"expected dates such as 20260301120000, different"),
        (["a1", "b1"], {"times": "index"}, r"expected indices, different in each image of a camera, found a1"),
    ],
)  # fmt: skip
def test_names_without_a_reading_are_refused(drive, names, options, expected):
    with pytest.raises(InputError, match=expected):
        opened(drive, names, **options)


@pytest.mark.parametrize("lost", [None, "CAM_FRONT", "CAM_BACK"])
def test_cameras_that_do_not_fire_together_are_matched(drive, lost):
    """The back camera follows by 9 ms; both are up to 4 ms early or late. Image 7 of one of them is missing."""
    times = {"CAM_FRONT": jittered(10, 1), "CAM_BACK": [0.009 + time for time in jittered(10, 2)]}
    names = {camera: [f"{camera}_{START_S * 10**6 + round(time * 1e6)}" for time in of] for camera, of in times.items()}
    if lost:
        del names[lost][7]
    sequence = FolderDrive(images(drive, names), InputOptions(ego_motion="static"))
    (line,) = (note for note in sequence.notes if "frames.csv is missing" in note)
    farthest = max(abs(a - b) for a, b in zip(*times.values(), strict=True))
    assert "times are microseconds since 1970, 2 cameras at 10.0 Hz, matched to CAM_FRONT within" in line
    assert lost or f"within {np.ceil(farthest * 1e3):.0f} ms, none of 80 images missing" in line
    assert not lost or "1 of 80 images missing" in line
    assert len(sequence.stamps) == 40
    for place, entry in enumerate(sequence._entries):
        expected = {"CAM_FRONT", "CAM_BACK"} - ({lost} if place == 7 else set())
        assert entry.sources.keys() == expected
        for camera in expected:
            assert entry.sources[camera].timestamp_ns == START_S * 10**9 + round(times[camera][place] * 1e6) * 1000
    if lost:
        assert f"the folder {lost} has no image within 50 ms" in sequence._entries[7].dropped[lost]


def test_the_slowest_camera_sets_the_frames(drive):
    names = {
        "CAM_FRONT": [f"{n * 33_333}" for n in range(60)],
        "CAM_BACK": [f"{11_000 + n * 100_000}" for n in range(20)],
    }
    sequence = open_sequence(images(drive, names), ego_motion="static")
    assert seconds(sequence) == [n / 10 for n in range(20)]
    assert any("2 cameras at 10.0 to 30.0 Hz, matched to CAM_BACK within" in note for note in sequence.notes)


@pytest.mark.parametrize("inside", ["images", "."])
def test_folders_of_cameras_may_have_other_names(drive, inside):
    names = {"front": ["fr_0001", "fr_0002"], "Back": ["bk_0001", "bk_0002"]}
    sequence = open_sequence(images(drive, names, inside), ego_motion="static")
    assert any(note.endswith("; front is CAM_FRONT, Back is CAM_BACK") for note in sequence.notes)
    assert [stamp.index for stamp in sequence.stamps] == [1, 2]
    if inside == ".":  # a folder of cameras alone is a drive
        calibration = (drive / "calibration.json").rename(drive.parent / "rig.json")
        (drive / "ego_motion.csv").unlink()
        assert len(open_sequence(drive, calibration=calibration, ego_motion="static").stamps) == 2


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (["cam_front", "CAM_FRONT_LEFT"], {"CAM_FRONT": "cam_front", "CAM_FRONT_LEFT": "CAM_FRONT_LEFT"}),
        (["f", "fl"], {"CAM_FRONT": "f", "CAM_FRONT_LEFT": "fl"}),
        (["frontLeft", "camera_front"], {"CAM_FRONT": "camera_front", "CAM_FRONT_LEFT": "frontLeft"}),
        (["front", "Cam-Front", "left"], {}),  # ambiguous, and not the same
    ],
)
def test_names_of_cameras_match_where_it_is_unambiguous(found, expected):
    assert match_names(("CAM_FRONT", "CAM_FRONT_LEFT"), found) == expected


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
    drive = images_of(tmp_path / "drive", "cam0", "cam3", count=1)
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


def test_the_time_of_the_first_image_may_be_stated_for_any_times(tmp_path):
    """A computer without a clock wrote the poses: the advice of the error is followed."""
    drive = images_of(tmp_path, "CAM_FRONT", count=4)
    for index, path in enumerate(sorted((drive / "CAM_FRONT").iterdir())):
        path.rename(path.with_name(f"{1_700_000_000 + index / 2:.1f}.jpg"))
    poses = "\n".join(f"{1.1 + index / 10:.1f} {index / 5} 0 0 0 0 0 1" for index in range(40))
    (tmp_path / "poses.txt").write_text(poses)
    how = {"fov_deg": 65, "height": 1.5, "ego_motion_file": tmp_path / "poses.txt", "image_check": False}
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
    with pytest.raises(
        InputError, match=r"has no calibration \(expected calib.txt, calib_cam_to_cam.txt .* or .*/perspective.txt"
    ):
        open_sequence(drive)
    yaws = {"image_02": 0, "image_03": 0}
    assert open_sequence(drive, fov_deg=65, height=1.65, yaw_deg=yaws, ego_motion="static").rig


def test_a_part_of_kitti_alone_says_what_to_give(tmp_path):
    drive = images_of(tmp_path / "training/image_02/0000", ".")
    (tmp_path / "training/calib").mkdir()
    (tmp_path / "training/calib/0000.txt").write_text(rows(P2=K @ np.eye(3, 4)))
    with pytest.raises(InputError, match=r"is of KITTI tracking, .*--calibration .*/training/calib/0000.txt"):
        open_sequence(drive)
    (tmp_path / "calib_cam_to_pose.txt").write_text(rows(image_00=np.eye(3, 4)))
    with pytest.raises(InputError, match=r"has poses of cameras and no intrinsics: pass perspective.txt"):
        open_sequence(kitti_raw(tmp_path), calibration=tmp_path / "calib_cam_to_pose.txt")
    with pytest.raises(InputError, match=r"sequences: is no folder of poses \(expected data and timestamps.txt"):
        open_sequence(kitti_odometry(tmp_path, "poses/07.txt"), ego_motion_file=tmp_path / "sequences")


def test_kitti_360_as_it_lies_on_disk(tmp_path):
    """Poses of some frames, by their numbers, of an IMU 0.6 m above the road with x forward, y right, z down."""
    truth = open_sequence(STREET, ground_truth=False)
    drive, name = tmp_path / "data_2d_raw/2013_05_28_drive_0000_sync", "image_00"
    camera, times = truth.rig["CAM_FRONT"], [stamp.timestamp_ns for stamp in truth.stamps[:8]]
    (drive / name / "data_rect").mkdir(parents=True)
    for number in range(8):
        shutil.copy(STREET / f"images/CAM_FRONT/{number:06d}.jpg", drive / name / f"data_rect/{number:010d}.jpg")
    (drive / name / "timestamps.txt").write_text("\n".join(f"{time / 1e9:.9f}" for time in times))
    ego_from_imu = rigid((0, 0, 0.6), np.diag([1.0, -1, -1]))
    rectified = rotation_about_z(0.02)
    numbers = {
        "calibration/perspective.txt": [
            f"S_rect_00: {camera.width} {camera.height}",
            f"R_rect_00: {text_of(rectified)}",
            f"P_rect_00: {text_of(np.column_stack([camera.intrinsics, np.zeros(3)]))}",
        ],
        "calibration/calib_cam_to_pose.txt": [
            f"{name}: {text_of((np.linalg.inv(ego_from_imu) @ camera.ego_from_camera @ rigid(rotation=rectified))[:3])}"
        ],
        f"data_poses/{drive.name}/poses.txt": [
            f"{number} {text_of((truth.ego_motion.pose_at(times[number]).matrix @ ego_from_imu)[:3])}"
            for number in range(1, 8)  # the first frame has none
        ],
    }
    for path, lines in numbers.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text("\n".join(lines))
    found = open_sequence(drive, rate_hz="all")
    np.testing.assert_allclose(found.rig[name].ego_from_camera[:3, :3], camera.ego_from_camera[:3, :3], atol=1e-6)
    assert found.rig[name].ego_from_camera[2, 3] == pytest.approx(camera.ego_from_camera[2, 3], abs=0.05)
    times = [stamp.timestamp_ns for stamp in found.stamps]
    assert times == pytest.approx([stamp.timestamp_ns for stamp in truth.stamps[1:8]], abs=1000)
    ways = [np.linalg.norm(np.diff([drive.ego_motion.pose_at(time).translation for time in times], axis=0), axis=1)
            for drive in (found, truth)]  # fmt: skip
    np.testing.assert_allclose(*ways, atol=0.02)


def text_of(matrix):
    return " ".join(f"{number:.9e}" for number in np.ravel(matrix))
