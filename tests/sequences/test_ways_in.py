"""The same real drive as a native folder, six videos and a nuScenes root gives the same frames."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from memory_drive import MemoryDrive

from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import wrap_angle
from bevcli.sequences.files.boxes_file import count_classes
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats import WriteOptions
from bevcli.workshop.formats.convert import open_writer, truth_left_out
from bevcli.workshop.formats.map_lines import MapLines
from bevcli.workshop.formats.output import NativeWriter


def assert_same_rig(one: CameraRig, other: CameraRig) -> None:
    assert set(one.names) == set(other.names)
    np.testing.assert_allclose(one.ego_from_bev, other.ego_from_bev, atol=1e-12)
    for name in one.names:
        assert (one[name].width, one[name].height) == (other[name].width, other[name].height)
        np.testing.assert_allclose(one[name].intrinsics, other[name].intrinsics, atol=1e-9)
        np.testing.assert_allclose(one[name].ego_from_camera, other[name].ego_from_camera, atol=1e-9)


def assert_same_frames(one, other, *, same_bytes: bool) -> None:
    assert [stamp.timestamp_ns for stamp in one.stamps] == [stamp.timestamp_ns for stamp in other.stamps]
    for place in range(len(one.stamps)):
        a, b = one.load(place), other.load(place)
        assert_same_rig(a.rig, b.rig)
        np.testing.assert_allclose(a.world_from_ego.matrix, b.world_from_ego.matrix, atol=1e-9)
        np.testing.assert_allclose(a.world_from_ego.quaternion, b.world_from_ego.quaternion, atol=1e-6)
        for name in a.rig.names:
            np.testing.assert_allclose(a.world_from_ego_at[name].matrix, b.world_from_ego_at[name].matrix, atol=1e-9)
            assert a.images[name].timestamp_ns == b.images[name].timestamp_ns
            np.testing.assert_array_equal(a.images[name].pixels_bgr, b.images[name].pixels_bgr)
            assert not same_bytes or a.images[name].encoded == b.images[name].encoded
        for quantity in ("acceleration", "angular_rate", "velocity"):
            np.testing.assert_allclose(getattr(a.kinematics, quantity), getattr(b.kinematics, quantity), atol=1e-12)
        np.testing.assert_allclose(a.ground_truth.centers, b.ground_truth.centers, atol=1e-9)
        np.testing.assert_allclose(a.ground_truth.sizes_lwh, b.ground_truth.sizes_lwh, atol=1e-9)
        np.testing.assert_allclose(wrap_angle(a.ground_truth.yaws - b.ground_truth.yaws), 0, atol=1e-9)
        assert a.ground_truth.classes.tolist() == b.ground_truth.classes.tolist()


@pytest.mark.slow
def test_nuscenes_root_gives_the_same_frames(real_drive, nuscenes_root):
    sequence = open_sequence(nuscenes_root)
    assert sequence.has_ego_motion
    assert [stamp.scene for stamp in sequence.stamps] == ["scene-0103"] * 4
    assert_same_frames(open_sequence(real_drive), sequence, same_bytes=True)


@pytest.mark.parametrize("kind", ["real_drive", "nuscenes_root"])
def test_boxes_are_counted_as_they_are_read_without_images(kind, request):
    drive = open_sequence(request.getfixturevalue(kind))
    frames = [drive.ground_truth_frame(place) for place in range(len(drive.stamps))]
    assert drive.class_counts == count_classes(frame.ground_truth for frame in frames)
    assert drive.class_counts
    assert not any(frame.images for frame in frames)


@pytest.mark.parametrize("which", [pytest.param("native", marks=pytest.mark.slow), "nuscenes"])
def test_converted_sequence_gives_the_same_frames(real_drive, nuscenes_root, tmp_path, which):
    source = open_sequence(real_drive if which == "native" else nuscenes_root)
    with NativeWriter(tmp_path / "out", with_ego_motion=True) as writer:
        for place in range(len(source.stamps)):
            writer.write(source.load(place))
    assert_same_frames(source, open_sequence(tmp_path / "out"), same_bytes=True)


def test_without_can_bus_kinematics_come_from_the_poses(nuscenes_root, tmp_path):
    """The car drives at 8.4 m/s forward, according to its sensors."""
    shutil.copytree(nuscenes_root, tmp_path / "root", ignore=shutil.ignore_patterns("can_bus"))
    measured, derived = open_sequence(nuscenes_root), open_sequence(tmp_path / "root")
    assert any("no CAN bus" in note for note in derived.notes)
    for place in range(4):
        a, b = measured.load(place).kinematics, derived.load(place).kinematics
        np.testing.assert_allclose(a.velocity, b.velocity, atol=0.3)
        np.testing.assert_allclose(a.angular_rate[2], b.angular_rate[2], atol=0.03)
        np.testing.assert_allclose(a.acceleration, b.acceleration, atol=0.8)


LINE = np.array([[1.0, 2.0], [3.0, 14.0]])


def with_lines(drive: MemoryDrive, index: int):
    return replace(drive.load(index), ground_truth_results=(MapLines((LINE,), np.array(["divider"])),))


def test_a_sequence_folder_keeps_the_lines_of_each_frame(tmp_path):
    drive = MemoryDrive(2)
    for source, target in ((None, "one"), ("one", "two")):
        read = None if source is None else open_sequence(tmp_path / source)
        with open_writer(tmp_path / target, drive, WriteOptions()) as writer:
            for place in range(2):
                writer.write(with_lines(drive, place) if read is None else read.load(place))
    read = open_sequence(tmp_path / "two")
    for place in range(2):
        (lines,) = read.load(place).ground_truth_results
        assert list(lines.classes) == ["divider"]
        np.testing.assert_allclose(lines.points[0], LINE, atol=0.005)


@pytest.mark.parametrize(("form", "expected"), [("native", set()), ("nuscenes", {"lines of the map"})])
def test_a_format_names_the_truth_that_it_leaves_out(form, expected):
    assert truth_left_out(with_lines(MemoryDrive(1), 0), form) == expected
