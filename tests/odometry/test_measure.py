"""The measured motion of a drive, against the motion with which it was rendered."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame
from bevcli.geometry.transforms import Array, inverse
from bevcli.sequences.open import open_sequence
from bevcli.sequences.view import DriveView
from bevcli.workshop.odometry.measure import MotionMeter, measure_motion

STREET = "samples/street"


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
    return replace(
        frame,
        images={name: replace(each, pixels_bgr=np.zeros_like(each.pixels_bgr)) for name, each in frame.images.items()},
    )


def test_a_step_without_images_is_a_guess_that_says_why() -> None:
    drive, meter = open_sequence(STREET), MotionMeter()
    frame = drive.load(0)
    later = replace(frame, stamp=drive.stamps[1])
    assert meter.add(black(frame)) == []
    (step,) = meter.add(black(later))
    assert "no image shows anything" in step.reason
    assert step.deviations[3] > 1.0
    assert meter.finish() == []


def test_a_drive_of_one_frame_is_refused() -> None:
    drive = open_sequence(STREET, frames=slice(0, 1))
    with pytest.raises(InputError, match="has 1 frames"):
        measure_motion(drive)
