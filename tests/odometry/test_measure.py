"""The measured motion of a drive, against the motion with which it was rendered; its types, memory and whole way."""

import contextlib
import re
import resource
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from command_line import command
from interrupted import run_frames
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation
from true_motion import STREET, motion_of, street_copy

import bevcli
from bevcli.errors import InputError
from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_about_z
from bevcli.sequences.open import DriveView, open_sequence
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep, MotionMeter, measure_motion, measure_steps
from bevcli.workshop.odometry.step_views import exponential, logarithm


def true_steps(drive: Drive) -> list[Array]:
    """The motions (4, 4) between the frames of a drive."""
    assert drive.ego_motion is not None
    poses = [drive.ego_motion.pose_at(stamp.timestamp_ns).matrix for stamp in drive.stamps]
    return [inverse(a) @ b for a, b in pairwise(poses)]


@pytest.mark.slow
def test_the_motion_of_a_rendered_drive_is_found() -> None:
    drive = open_sequence(STREET, frames=slice(3, 11))  # with a turn
    motion, true = measure_motion(drive), true_steps(drive)
    errors = [inverse(a) @ step.ego_a_from_ego_b for a, step in zip(true, motion.steps, strict=True)]
    metres = [float(np.linalg.norm(error[:3, 3])) for error in errors]
    degrees = [np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude()) for error in errors]
    assert np.median(metres) < 0.005
    assert max(metres) < 0.03
    assert max(degrees) < 0.03
    assert not any(step.reason for step in motion.steps)
    way = sum(float(np.linalg.norm(step[:3, 3])) for step in true)
    end = inverse(inverse(drive.load(0).world_from_ego.matrix) @ drive.load(7).world_from_ego.matrix) @ motion.poses[-1]
    assert np.linalg.norm(end[:3, 3]) < 0.005 * way
    moved = DriveView(drive, motions={drive.stamps[0].scene: motion.ego_motion}).load(4)
    np.testing.assert_allclose(moved.kinematics.velocity, drive.load(4).kinematics.velocity, atol=0.15)


def black(frame: Frame) -> Frame:
    """The frame with black images."""
    dark = {name: replace(each, pixels_bgr=0 * each.pixels_bgr) for name, each in frame.images.items()}
    return replace(frame, images=dark)


def test_a_step_without_images_is_a_guess_that_says_why() -> None:
    drive, meter = open_sequence(STREET), MotionMeter()
    frame = drive.load(0)
    later = replace(frame, stamp=drive.stamps[1])
    assert meter.add(black(frame)) == []
    (step,) = meter.add(black(later))
    assert "no image shows anything" in step.reason
    assert step.deviations[3] > 1.0
    assert meter.finish() == []
    with pytest.raises(InputError, match="has 1 frames"):
        measure_motion(open_sequence(STREET, frames=slice(0, 1)))


STEPS, STEP_NS = 300, 500_000_000
GROWS_MIB = 30.0  # at most, after a third of the steps; features of frames that are kept would be 100 MiB


class ToAndFro(DerivedDrive):
    """The first frames of a drive to and fro, in images of half the size of its first camera."""

    def __init__(self, sequence: Drive, frames: int, count: int) -> None:
        super().__init__(sequence)
        first, turn = sequence.stamps[0], 2 * (frames - 1)
        self._places = [min(place % turn, turn - place % turn) for place in range(count)]
        self.stamps = tuple(
            replace(first, index=place, timestamp_ns=first.timestamp_ns + place * STEP_NS) for place in range(count)
        )
        self.rig = replace(sequence.rig, cameras=(sequence.rig.cameras[0].scaled(0.5),))

    def load(self, index: int) -> Frame:
        frame, stamp, (camera,) = self.drive.load(self._places[index]), self.stamps[index], self.rig.cameras
        image = frame.images[camera.name]
        half = cv2.resize(image.pixels_bgr, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        images = {camera.name: replace(image, timestamp_ns=stamp.timestamp_ns, pixels_bgr=half.astype(np.uint8))}
        poses = {camera.name: frame.world_from_ego}
        return replace(frame, stamp=stamp, rig=self.rig, images=images, world_from_ego_at=poses)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_memory_stays_flat_over_many_steps() -> None:
    drive = ToAndFro(open_sequence(STREET, ground_truth=False), 6, STEPS + 1)
    peaks = [resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 for _ in measure_steps(drive)]
    assert len(peaks) == STEPS
    assert peaks[-1] - peaks[STEPS // 3] < GROWS_MIB


SECOND = 1_000_000_000


def circle(steps: int) -> MeasuredMotion:
    """A vehicle on a circle of radius 10 m, anticlockwise, 0.2 radians a step of half a second."""
    step = rigid((10 * np.sin(0.2), 10 * (1 - np.cos(0.2)), 0), rotation_about_z(0.2))
    times = np.arange(steps + 1, dtype=np.int64) * SECOND // 2
    return MeasuredMotion("circle", times, (MeasuredStep(step, np.eye(6)),) * steps)


@pytest.mark.parametrize("twist", [(0.3, -0.2, 0.5, 4, 1, -0.5), (0, 0, 1e-10, 1, 2, 3), (0, 0, 0, 0, 0, 0)])
def test_exponential_is_that_of_matrices(twist: tuple[float, ...]) -> None:
    a, b, c, *velocity = twist
    generator = np.zeros((4, 4))
    generator[:3] = np.column_stack([[[0, -c, b], [c, 0, -a], [-b, a, 0]], velocity])
    motion = exponential(np.array(twist))
    np.testing.assert_allclose(motion, expm(generator), atol=1e-9)
    np.testing.assert_allclose(logarithm(motion), twist, atol=1e-9)
    np.testing.assert_allclose(np.real(logm(motion)), generator, atol=1e-7)


def test_poses_lie_on_the_circle_at_and_between_frames() -> None:
    motion = circle(8)
    np.testing.assert_allclose(motion.poses[0], np.eye(4))
    centre = np.array([0, 10, 0])
    for time in range(-SECOND // 10, 4 * SECOND + SECOND // 10, SECOND // 40):
        pose, angle = motion.ego_motion.pose_at(time), 0.4 * time / SECOND
        np.testing.assert_allclose(pose.translation - centre, [10 * np.sin(angle), -10 * np.cos(angle), 0], atol=2e-3)
        assert pose.yaw == pytest.approx(angle, abs=1e-6)
    at = motion.ego_motion.kinematics_at(2 * SECOND)
    np.testing.assert_allclose(at.velocity, [4, 0, 0], atol=0.05)
    np.testing.assert_allclose(at.angular_rate, [0, 0, 0.4], atol=0.01)
    np.testing.assert_allclose(at.acceleration, [0, 1.6, 9.81], atol=0.05)


def test_the_measured_road_is_that_of_each_frame() -> None:
    """A vehicle that pitches by 1°, nose down, from its second frame on: the direction up from the road is aft then."""
    angle = np.radians(1.0)
    pitched = rigid((2, 0, 0), [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    aft = np.array([-np.sin(angle), 0, np.cos(angle)])
    still = MeasuredStep(rigid((2, 0, 0)), np.eye(6), road=aft)
    steps = MeasuredStep(pitched, np.eye(6), road=aft), still
    motion = MeasuredMotion("brakes", np.arange(3, dtype=np.int64) * SECOND, steps).ego_motion
    for second, expected in enumerate([(0, 0, 1), aft, aft]):
        np.testing.assert_allclose(motion.road_normal_at(second * SECOND), expected, atol=1e-12)
    np.testing.assert_allclose(motion.of_rows(np.arange(3)).road_normal_at(0), (0, 0, 1), atol=1e-3)


FRAMES = 5
ROOT = STREET.parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return street_copy(tmp_path_factory.mktemp("street") / "drive", FRAMES)


@pytest.fixture(scope="module")
def true_poses():
    return motion_of(bevcli.open_sequence(STREET, frames=slice(0, FRAMES), ground_truth=False)).poses


@pytest.mark.slow
def test_the_written_poses_are_those_of_the_drive(folder, true_poses, tmp_path):
    done = command(tmp_path, "odometry", str(folder), "--out", "out")
    assert done.returncode == 0, done.stderr
    assert "not measured  no step" in done.stdout
    drive = bevcli.open_sequence(folder, ego_motion_file=tmp_path / "out/ego_motion.csv")
    for place, pose in enumerate(true_poses):
        assert drive.load(place).world_from_ego.translation == pytest.approx(pose[:3, 3], abs=0.05)


@pytest.mark.slow
def test_a_stopped_run_goes_on_to_the_same_boxes(folder, tmp_path):
    """The motion is measured again, with the same result to the bit."""
    model = bevcli.load_model("demo")
    drives = [bevcli.open_sequence(folder, odometry=True, frames=slice(0, 4)) for _ in range(2)]
    assert (drives[0].ego_motion.translations == drives[1].ego_motion.translations).all()
    bevcli.run_into_folder(model, drives[0], tmp_path / "whole")
    run_frames(2, model, drives[0], tmp_path / "cut")
    bevcli.run_into_folder(model, drives[1], tmp_path / "cut", resume=True)
    whole, cut = ((tmp_path / name / "predictions.json").read_bytes() for name in ("whole", "cut"))
    assert whole == cut


@pytest.mark.slow
def test_the_example_of_the_page_runs():
    [example] = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/odometry.md").read_text(), re.MULTILINE | re.DOTALL)
    with contextlib.chdir(ROOT):
        exec(example, {})
