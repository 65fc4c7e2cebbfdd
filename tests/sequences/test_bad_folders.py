"""A native folder: its frames have the times, poses and images in its files, and a mistake is named in one line."""

import os
import shutil

import cv2
import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.sequences.open import open_sequence


def message(folder, place=0, **options):
    """The error message of opening the folder or loading a frame."""
    with pytest.raises(InputError) as caught:
        open_sequence(folder, **options).load(place)
    return str(caught.value)


def test_what_is_no_drive_is_named(drive, tmp_path):
    assert str(tmp_path / "nothing") in message(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    assert "is not a sequence folder" in message(tmp_path / "empty")
    assert "is a file" in message(drive / "frames.csv")
    assert 'no scene "x"' in message(drive, scene="x")


def test_a_folder_that_is_gone_is_an_error(drive):
    sequence = open_sequence(drive)
    shutil.rmtree(drive)
    with pytest.raises(InputError, match="the folder is gone"):
        sequence.load(0)


@pytest.mark.parametrize("file", ["calibration.json", "ego_motion.csv"])
def test_missing_file(drive, file):
    (drive / file).unlink()
    line = message(drive)
    assert f"{drive / file}" in line
    assert "missing" in line
    if file == "ego_motion.csv":
        assert '`ego_motion="static"`' in line
        assert "`temporal=False`" in line


@pytest.mark.parametrize("file", ["frames.csv", "ego_motion.csv", "ground_truth.json", "timing.toml"])
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("nowhere")], ids=["pipe", "link"])
def test_an_optional_file_that_is_no_file_is_not_passed_over(drive, file, make):
    """A drive is not read as if the file were missing."""
    (drive / file).unlink(missing_ok=True)
    if file == "timing.toml":
        (drive / "frames.csv").unlink()
    make(drive / file)
    assert str(drive / file) in message(drive)


def test_a_video_index_of_5000_digits_is_a_missing_image(edit):
    frame = open_sequence(edit("frames.csv", "0.png", f"0.png#{'9' * 5000}")).load(0)
    assert list(frame.dropped) == ["CAM_FRONT"]


def test_neither_table_nor_images(drive):
    (drive / "frames.csv").unlink()
    shutil.rmtree(drive / "images")
    line = message(drive)
    assert "frames.csv" in line
    assert "images" in line
    assert "videos" in line


@pytest.mark.parametrize("content", ["{", "[]", "\xff"])
def test_broken_json(drive, content):
    (drive / "calibration.json").write_bytes(content.encode("latin-1"))
    assert "calibration.json" in message(drive)


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        ("frames.csv", "timestamp_ns,", "time,", ["timestamp_ns", "missing"]),
        ("frames.csv", "CAM_BACK.timestamp_ns", "CAM_LEFT.timestamp_ns", ["unknown column", "CAM_LEFT.timestamp_ns"]),
        ("frames.csv", "CAM_BACK.timestamp_ns", "CAM_BACK", ["CAM_BACK", "twice"]),
        ("frames.csv", "11,", "11,7,", ["line 3", "6 cells", "expected 5"]),
        ("frames.csv", "1500000000,images", "1.5e9,images", ["line 3", "timestamp_ns", '"1.5e9"', "integer"]),
        ("frames.csv", "1500000000,images", ",images", ["line 3", "timestamp_ns", '""', "integer"]),
        ("frames.csv", "1500000000,images", "1000000000,images", ["line 3", "1000000000", "is not later than"]),
        ("frames.csv", "1500000000,images", "2000000001,images", ["line 4", "2000000001", "is not later than"]),
        ("frames.csv", "1520000000", "nan", ["line 3", "CAM_BACK.timestamp_ns", '"nan"']),
        ("frames.csv", "\n11,", "\n10,", ["line 3", "frame", "10", "line 2"]),
        ("frames.csv", "\n11,", "\n-1,", ["line 3", "frame", "negative"]),
        ("frames.csv", "2520000000", "2670000000", ["ego_motion.csv", "CAM_BACK", "2670000000", "frames.csv: line 5"]),
        ("ego_motion.csv", "qz\n", "qz,ax,ay\n", ["line 2", "8 cells", "expected 10"]),
        ("ego_motion.csv", "qw,qx", "qx,qw2", ["ego_motion.csv", "qw", "missing"]),
        ("ego_motion.csv", "1000000000,10.0", "1000000000,nan", ["line 3", "column x", "finite", "nan"]),
        ("ego_motion.csv", "1000000000,10.0", "1000000000,ten", ["line 3", "column x", '"ten"']),
        ("ego_motion.csv", "1000000000,10.0", "1000000000,1_0.0", ["line 3", "column x", "number", '"1_0.0"']),
        ("ego_motion.csv", "1000000000,10.0", "1000000000,\u0661", ["line 3", "column x", "number"]),
        ("frames.csv", ".png", "\0.png", ["frames.csv: line 2", "null byte"]),
        ("ego_motion.csv", "1000000000,10.0", "900000000,10.0", ["line 3", "timestamp_ns", "900000000"]),
        ("ego_motion.csv", "1000000000,10.0", "1000000000.0,10.0", ["line 3", "timestamp_ns", "integer"]),
        ("ego_motion.csv", "10.0,0,0,1,0,0,0", "10.0,0,0,0.99,0,0,0", ["line 3", "norm is 0.99"]),
        ("ego_motion.csv", "10.0,0,0,1,0,0,0", "10.0,0,0,0,0,0,0", ["line 3", "norm is 0"]),
    ],
)
def test_wrong_cells_and_columns(edit, file, old, new, expected):
    line = message(edit(file, old, new))
    assert file in line
    for part in expected:
        assert part in line


def test_incomplete_group_of_optional_columns(drive):
    rows = (drive / "ego_motion.csv").read_text().splitlines()
    (drive / "ego_motion.csv").write_text("\n".join([rows[0] + ",vx", *(row + ",1" for row in rows[1:])]))
    line = message(drive)
    assert "vx, vy, vz" in line
    assert "only vx" in line


@pytest.mark.parametrize("file", ["frames.csv", "ego_motion.csv"])
@pytest.mark.parametrize("rows", [0, 1])
def test_no_rows(drive, file, rows):
    text = (drive / file).read_text().splitlines(keepends=True)
    (drive / file).write_text("".join(text[:rows]))
    line = message(drive)
    assert file in line
    assert ("no rows" if rows else "empty") in line


def test_cameras_and_columns_that_do_not_match(edit, drive):
    edit("calibration.json", '"CAM_BACK"', '"CAM_LEFT"')
    assert 'unknown column "CAM_BACK"' in message(drive)
    edit("calibration.json", '"CAM_LEFT"', '"CAM_BACK"')
    rows = (drive / "frames.csv").read_text().splitlines()
    (drive / "frames.csv").write_text("\n".join(",".join(row.split(",")[:3]) for row in rows))
    assert "frames.csv: camera CAM_BACK" in message(drive)


def test_image_of_another_size(drive):
    cv2.imwrite(str(drive / "images/CAM_BACK/2.png"), np.zeros((30, 64, 3), np.uint8))
    line = message(drive, place=2)
    assert "CAM_BACK/2.png" in line
    assert "64x30" in line
    assert "64x36" in line


@pytest.mark.parametrize("content", [None, b"no image"], ids=["missing", "unreadable"])
def test_strict_makes_a_bad_image_an_error(drive, edit, content):
    path = drive / "images/CAM_BACK/1.png"
    path.unlink() if content is None else path.write_bytes(content)
    line = message(drive, strict=True, place=1)
    assert "camera CAM_BACK" in line
    assert str(path) in line
    if content is None:
        line = message(edit("frames.csv", "images/CAM_BACK/1.png", ""), strict=True, place=1)
        assert "CAM_BACK" in line
        assert "frames.csv" in line


def test_names_of_images_that_do_not_fit(drive):
    (drive / "frames.csv").unlink()
    for number in range(4):
        (drive / f"images/CAM_BACK/{number}.png").rename(drive / f"images/CAM_BACK/{number + 100}.png")
    assert "CAM_BACK has 100 to 103, and CAM_FRONT has 0 to 3" in message(drive, image_rate_hz=2.0)
    (drive / "images/CAM_BACK/102.png").rename(drive / "images/CAM_BACK/two.png")
    assert "two.png" in message(drive)


@pytest.mark.parametrize("option", [{"start_ns": 5}, {"image_rate_hz": 2.0}, {"times": "ns"}])
def test_times_of_images_beside_a_table_that_states_them(drive, option):
    line = message(drive, **option)
    assert "frames.csv: states the times of all images" in line
    assert f"`{next(iter(option))}` " in line


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("rate_hz = 0", "rate_hz"),
        ("rate_hz = true", "rate_hz"),
        ("start_ns = 1.5", "start_ns"),
        ("fps = 2", "`fps`"),
        ("[cameras.CAM_UP]\noffset_ns = 1", 'unknown camera "CAM_UP"'),
        ("[cameras.CAM_BACK]\noffset_s = 1", "`offset_s`"),
        ("rate_hz =", "TOML"),
    ],
)
def test_wrong_timing(drive, content, expected):
    (drive / "frames.csv").unlink()
    (drive / "timing.toml").write_text(content)
    line = message(drive)
    assert "timing.toml" in line
    assert expected in line


@pytest.mark.parametrize(("character", "name"), [(";", "semicolons"), ("\t", "tabs")])
@pytest.mark.parametrize("file", ["frames.csv", "ego_motion.csv"])
def test_a_table_with_another_separator_says_so(drive, file, character, name):
    table = drive / file
    table.write_text(table.read_text().replace(",", character))
    assert f"{table}: the columns are separated by {name} (expected commas)" in message(drive)


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
