"""Coverage of a rig whose field of view can be worked out by hand."""

import json

import numpy as np
import pytest
from healthy_rigs import camera, copy_of, rig

from bevcli.geometry.bev_grid import BevGrid
from bevcli.rig.coverage import coverage_of
from bevcli.rig.drawings import horizon
from bevcli.rig.rig_checks import mounting_of, seen_fov_deg
from bevcli.sequences.files.calibration_file import read_calibration


def rig_of(document, folder):
    (folder / "calibration.json").write_text(json.dumps(document))
    return read_calibration(folder / "calibration.json")


def test_one_level_camera_sees_its_quadrant(tmp_path):
    """90° across at the bev frame's origin: far from the camera it sees |x| < y, and pillars as high as the camera."""
    document = rig({"front": camera((0.94, 0.0, 1.84), 0, 800.0)})
    document["cameras"]["front"]["intrinsics"][0][2] = 800.0
    grid = BevGrid(rows=40, columns=42)  # no cell lies on the diagonal
    coverage = coverage_of(rig_of(document, tmp_path), grid)
    x, y = np.moveaxis(grid.cell_centers(), -1, 0)
    far = y > 12  # nearer, the highest and lowest points leave the image, yet some of each pillar stays in it
    np.testing.assert_array_equal(coverage.counts[far], (np.abs(x) < y)[far].astype(int))
    assert (coverage.counts[y < 0] == 0).all()
    assert coverage.shares["front"] == coverage.counts.mean() == 1 - coverage.unseen


def test_two_equal_cameras_see_each_cell_twice(tmp_path):
    one = camera((0.94, 0.0, 1.84), 0, 800.0)
    coverage = coverage_of(rig_of(rig({"a": one, "b": one}), tmp_path))
    assert set(np.unique(coverage.counts)) == {0, 2}
    assert coverage.overlap == coverage.shares["a"]


@pytest.mark.parametrize(
    ("yaw", "pitch", "roll"), [(0, 0, 0), (55, 3, -4), (-110, -20, 8), (180, 10, 0), (90, -45, 20), (0, 30, 180)]
)
def test_the_mounting_has_the_angles_the_camera_was_turned_by(yaw, pitch, roll, tmp_path):
    document = rig({"any": camera((1.0, 0.5, 1.6), yaw, 900.0, pitch=pitch, roll=roll)})
    mounting = mounting_of(rig_of(document, tmp_path)["any"].ego_from_camera)
    found = np.exp(1j * np.radians([mounting.yaw_deg, mounting.pitch_deg, mounting.roll_deg]))
    np.testing.assert_allclose(found, np.exp(1j * np.radians([yaw, pitch, roll])), atol=1e-12)
    assert mounting.height == 1.6


def test_the_field_of_view_of_a_pinhole(tmp_path):
    for focal, degrees in ((800.0, 90.0), (800.0 / np.tan(np.radians(15)), 30.0)):
        document = rig({"any": camera((0, 0, 1.6), 0, focal)})
        document["cameras"]["any"]["intrinsics"][0][2] = 800.0
        assert seen_fov_deg(rig_of(document, tmp_path)["any"])[0] == pytest.approx(degrees, abs=0.2)


def test_a_level_cameras_horizon_is_its_principal_points_row(tmp_path):
    level = rig_of(rig({"any": camera((0, 0, 1.6), 30, 900.0)}), tmp_path)["any"]
    rows = horizon(level)[:, 1]
    np.testing.assert_allclose(rows[np.isfinite(rows)], level.intrinsics[1, 2], atol=1e-6)
    up = rig_of(rig({"any": camera((0, 0, 1.6), 30, 900.0, pitch=5)}), tmp_path)["any"]
    lowest = np.nanmin(horizon(up)[:, 1])  # of a camera that looks up the horizon lies below the middle
    assert lowest == pytest.approx(up.intrinsics[1, 2] + 900 * np.tan(np.radians(5)), abs=1e-3)


def test_every_healthy_rig_is_seen_by_its_cameras(tmp_path):
    for name in ("six", "four fisheyes", "seven"):
        coverage = coverage_of(rig_of(copy_of(name), tmp_path))
        assert all(share > 0.03 for share in coverage.shares.values())
