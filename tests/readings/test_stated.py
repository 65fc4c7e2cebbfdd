"""Mistakes in stated poses that the images show, each with what undoes it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stated_mistakes import about_z, motion_of

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


def changed(motion, change):
    return motion_of(
        motion.timestamps_ns, *change(motion.translations, Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1)))
    )


def with_axes(axes):
    """Poses whose world and vehicle have other axes."""
    return lambda at, turned: (at @ axes.T, Rotation.from_matrix(axes @ turned.as_matrix() @ axes.T))


def with_yaws(change):
    def change_yaws(at, turned):
        x, y, _ = turned.apply([1, 0, 0]).T
        return at, about_z(change(np.unwrap(np.arctan2(y, x))))

    return change_yaws


def inverted(at, turned):
    return -turned.inv().apply(at), turned.inv()


X_LEFT = np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]])
OPTICAL = np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])
MISTAKES = {
    "swapped": (lambda at, turned: (at[:, [1, 0, 2]], turned), "motion-axes", "hold y, x"),
    "negated": (lambda at, turned: (at * (1, -1, 1), turned), "motion-axes", "hold x, -y"),
    "left-handed": (with_axes(np.diag([1.0, -1, 1])), "motion-axes", "x forward, y right"),
    "x left": (with_axes(X_LEFT), "motion-axes", "x left"),
    "camera axes": (with_axes(OPTICAL), "motion-axes", "x right, y down"),
    "degrees": (with_yaws(np.degrees), "motion-angles", "in degrees, taken for radians"),
    "radians": (with_yaws(np.radians), "motion-angles", "in radians, taken for degrees"),
    "compass": (with_yaws(lambda yaws: np.pi / 2 - yaws), "motion-angles", "as a compass"),
    "clockwise": (with_yaws(lambda yaws: -yaws), "motion-angles", "clockwise from x"),
    "no rotations": (with_yaws(np.zeros_like), "motion-angles", "the course"),
    "inverted": (inverted, "motion-inverted", "body_from_world"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_the_reading_that_fits_is_named(street, monkeypatch, name):
    drive, pairs, motion = street
    monkeypatch.setattr(judge, "camera_pairs", lambda *_: pairs)
    change, code, words = MISTAKES[name]
    finding, undone = fitting_poses(drive, changed(motion, change))
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
