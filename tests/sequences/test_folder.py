"""The frames of a native folder have the times, poses and images in its files."""

import cv2
import numpy as np
import pytest

from bevcli.sequences.native.folder import FolderDrive
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions


def test_stamps_are_the_rows_of_frames_csv(drive):
    sequence = open_sequence(drive)
    assert [stamp.index for stamp in sequence.stamps] == [10, 11, 12, 13]
    assert [stamp.timestamp_ns for stamp in sequence.stamps] == [10**9, 15 * 10**8, 2 * 10**9, 25 * 10**8]
    assert {stamp.scene for stamp in sequence.stamps} == {""}
    assert sequence.name == "drive"
    assert open_sequence(str(drive)).stamps == sequence.stamps
    (drive.parent / "link").symlink_to(drive)
    assert open_sequence(drive.parent / "link").name == "drive"


def test_poses_are_those_at_the_frame_and_at_each_camera(drive):
    """At 10 m/s, 20 ms are 0.2 m."""
    frame = open_sequence(drive).load(1)
    np.testing.assert_allclose(frame.world_from_ego.translation, [15, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frame.world_from_ego_at["CAM_FRONT"].translation, [15, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frame.world_from_ego_at["CAM_BACK"].translation, [15.2, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frame.kinematics.velocity, [10, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frame.kinematics.acceleration, [0, 0, 9.81], atol=1e-6)


def test_images_are_those_in_the_files(drive):
    frame = open_sequence(drive).load(2)
    for camera, image in frame.images.items():
        path = drive / "images" / camera / "2.png"
        np.testing.assert_array_equal(image.pixels_bgr, cv2.imread(str(path)))
        assert image.encoded == path.read_bytes()
        assert image.media_type == "image/png"
    assert frame.images["CAM_BACK"].timestamp_ns == 2_020_000_000


def test_times_beyond_float_precision_are_exact(edit):
    """2**60 + 1 is not a float64."""
    drive = edit("ego_motion.csv", "2600000000,", f"{2**60 + 2},")
    text = (
        (drive / "frames.csv").read_text().replace("2520000000", str(2**60 + 2)).replace("2500000000", str(2**60 + 1))
    )
    (drive / "frames.csv").write_text(text)
    sequence = open_sequence(drive)
    assert sequence.stamps[3].timestamp_ns == 2**60 + 1
    assert sequence.load(3).images["CAM_BACK"].timestamp_ns == 2**60 + 2


@pytest.mark.parametrize("keep", [0, 40, -20], ids=["empty", "header", "cut short"])
def test_broken_image_is_dropped_with_its_name(drive, edit, keep):
    path = drive / "images/CAM_BACK/1.png"
    path.write_bytes(path.read_bytes()[:keep])
    frame = open_sequence(drive).load(1)
    assert list(frame.images) == ["CAM_FRONT"]
    assert str(path) in frame.dropped["CAM_BACK"]
    frame = open_sequence(edit("frames.csv", "images/CAM_BACK/1.png", "")).load(1)
    assert list(frame.images) == ["CAM_FRONT"]
    assert frame.dropped == {"CAM_BACK": "no image in frames.csv"}
    assert set(frame.world_from_ego_at) == {"CAM_FRONT", "CAM_BACK"}


def test_truncated_jpeg_is_dropped(drive, edit):
    """OpenCV fills what is missing with grey."""
    encoded = cv2.imencode(".jpg", cv2.imread(str(drive / "images/CAM_BACK/1.png")))[1].tobytes()
    path = drive / "images/CAM_BACK/1.jpg"
    path.write_bytes(encoded)
    edit("frames.csv", "CAM_BACK/1.png", "CAM_BACK/1.jpg")
    assert open_sequence(drive).load(1).images["CAM_BACK"].encoded == encoded
    path.write_bytes(encoded[: len(encoded) // 2])
    assert "not a complete image" in open_sequence(drive).load(1).dropped["CAM_BACK"]


def test_without_ego_motion_every_pose_is_the_identity(drive):
    sequence = open_sequence(drive, ego_motion="static")
    np.testing.assert_array_equal(sequence.load(3).world_from_ego.matrix, np.eye(4))
    assert any("not read" in note for note in sequence.notes)
    (drive / "ego_motion.csv").unlink()
    for use in ("static", "optional"):
        sequence = open_sequence(drive, ego_motion=use)
        assert not sequence.has_ego_motion
        assert sequence.notes
        np.testing.assert_array_equal(sequence.load(3).world_from_ego.matrix, np.eye(4))
        np.testing.assert_array_equal(sequence.load(3).kinematics.acceleration, [0, 0, 9.81])


def test_numbered_images_take_their_times_from_timing_toml(drive):
    table = open_sequence(drive)
    (drive / "frames.csv").unlink()
    (drive / "timing.toml").write_text("start_ns = 1000000000\nrate_hz = 2\n[cameras.CAM_BACK]\noffset_ns = 20000000\n")
    sequence = open_sequence(drive)
    for place in range(4):
        mine, stated = sequence.load(place), table.load(place)
        assert mine.stamp.timestamp_ns == stated.stamp.timestamp_ns
        for camera, image in stated.images.items():
            assert mine.images[camera].timestamp_ns == image.timestamp_ns
            np.testing.assert_array_equal(mine.images[camera].pixels_bgr, image.pixels_bgr)


def test_missing_image_number_leaves_a_gap_in_time(drive):
    (drive / "frames.csv").unlink()
    for camera in ("CAM_FRONT", "CAM_BACK"):
        (drive / "images" / camera / "1.png").unlink()
    sequence = FolderDrive(drive, InputOptions(ego_motion="static"))
    assert [stamp.timestamp_ns for stamp in sequence.stamps] == [0, 10**9, 15 * 10**8]
    assert any("assumed" in note for note in sequence.notes)


def test_ground_truth_in_the_ego_frame_is_moved_to_the_world(drive):
    box = {"class": "car", "center": [5, 1, 0.8], "size_lwh": [4, 2, 1.6], "yaw": 0.5, "velocity": [0, 0]}
    frames = (
        f'[{{"frame": 11, "scene": "", "timestamp_ns": 1500000000, "boxes": [{str(box).replace(chr(39), chr(34))}]}}]'
    )
    text = f'{{"format": "bevcli-boxes/1", "frame_of_reference": "ego", "frames": {frames}}}'
    (drive / "ground_truth.json").write_text(text)
    sequence = open_sequence(drive)
    np.testing.assert_allclose(sequence.load(1).ground_truth.centers, [[20, 1, 0.8]])
    assert sequence.load(0).ground_truth is None
    standing = open_sequence(drive, ego_motion="static")
    np.testing.assert_allclose(standing.load(1).ground_truth.centers, [[5, 1, 0.8]])


def test_exif_orientation_is_ignored(drive, edit):
    encoded = cv2.imencode(".jpg", cv2.imread(str(drive / "images/CAM_BACK/1.png")))[1].tobytes()
    exif = (
        b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # orientation 6: turn by 90 degrees
    )
    turned = encoded[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + encoded[2:]
    (drive / "images/CAM_BACK/1.jpg").write_bytes(turned)
    edit("frames.csv", "CAM_BACK/1.png", "CAM_BACK/1.jpg")
    assert open_sequence(drive).load(1).images["CAM_BACK"].pixels_bgr.shape == (36, 64, 3)
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (64, 36, 3)
