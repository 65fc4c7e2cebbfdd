"""Mistakes in stated poses that the images show, each with what undoes it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stated_mistakes import motion_of

from bevcli.sequences.open import open_sequence, select
from bevcli.workshop.odometry.compare import chosen_frames
from bevcli.workshop.readings import judge
from bevcli.workshop.readings.stated import fitting_poses

STREET = Path(__file__).parents[2] / "samples/street"


@pytest.fixture(scope="module")
def street():
    """Nine frames of the sample drive, the pairs of their images, and the poses."""
    drive = open_sequence(STREET, ground_truth=False)
    some = select(drive, chosen_frames(drive))
    judged = judge.Judged(judge.RigDraft(drive.rig, ()), judge.ReadPoses(drive.ego_motion), some, judge.RigOptions())
    return some, judged._pairs, drive.ego_motion


def changed(motion, positions=None, rotations=None):
    kept = Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1))
    at = motion.translations if positions is None else positions
    return motion_of(motion.timestamps_ns, at, kept if rotations is None else rotations)


def with_axes(motion, axes):
    """Poses whose world and vehicle have other axes."""
    rotations = Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1)).as_matrix()
    return changed(motion, motion.translations @ axes.T, Rotation.from_matrix(axes @ rotations @ axes.T))


def with_yaws(motion, changed_yaw):
    x, y, _ = Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1)).apply([1, 0, 0]).T
    yaws = changed_yaw(np.unwrap(np.arctan2(y, x)))
    return changed(motion, rotations=Rotation.from_rotvec(np.multiply.outer(yaws, (0, 0, 1))))


def inverted(motion):
    rotations = Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1)).inv()
    return changed(motion, -rotations.apply(motion.translations), rotations)


X_LEFT = np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]])
OPTICAL = np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])
MISTAKES = {
    "swapped": (lambda motion: changed(motion, motion.translations[:, [1, 0, 2]]), "motion-axes", "hold y, x"),
    "negated": (lambda motion: changed(motion, motion.translations * (1, -1, 1)), "motion-axes", "hold x, -y"),
    "left-handed": (lambda motion: with_axes(motion, np.diag([1.0, -1, 1])), "motion-axes", "x forward, y right"),
    "x left": (lambda motion: with_axes(motion, X_LEFT), "motion-axes", "x left"),
    "camera axes": (lambda motion: with_axes(motion, OPTICAL), "motion-axes", "x right, y down"),
    "degrees": (lambda motion: with_yaws(motion, np.degrees), "motion-angles", "in degrees, taken for radians"),
    "radians": (lambda motion: with_yaws(motion, np.radians), "motion-angles", "in radians, taken for degrees"),
    "compass": (lambda motion: with_yaws(motion, lambda yaws: np.pi / 2 - yaws), "motion-angles", "as a compass"),
    "clockwise": (lambda motion: with_yaws(motion, lambda yaws: -yaws), "motion-angles", "clockwise from x"),
    "no rotations": (lambda motion: with_yaws(motion, np.zeros_like), "motion-angles", "the course"),
    "inverted": (inverted, "motion-inverted", "body_from_world"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_the_reading_that_fits_is_named(street, monkeypatch, name):
    drive, pairs, motion = street
    monkeypatch.setattr(judge, "camera_pairs", lambda *_: pairs)
    change, code, words = MISTAKES[name]
    finding, undone = fitting_poses(drive, change(motion))
    assert finding.code == code, finding
    assert words in finding.found
    at, true = (
        np.stack([each.pose_at(stamp.timestamp_ns).matrix for stamp in drive.stamps]) for each in (undone, motion)
    )
    steps, right = (np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (at, true))
    assert np.abs(steps - right).max() < 0.05


@pytest.mark.parametrize("scale", [1.0, 1.08, 0.9])
def test_sound_poses_have_no_other_reading(street, monkeypatch, scale):
    drive, pairs, motion = street
    monkeypatch.setattr(judge, "camera_pairs", lambda *_: pairs)
    assert fitting_poses(drive, replace(motion, translations=scale * motion.translations)) is None
