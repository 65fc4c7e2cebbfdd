"""An undistorted rendering of a camera with a known lens resembles the rendering without a lens."""

from dataclasses import replace

import numpy as np
import pytest

from bevcli.geometry.cameras import CameraRig, Distortion
from bevcli.synth.drive import RenderedDrive
from bevcli.synth.rig import nuscenes_like_rig

LENSES = {
    "brown_conrady": Distortion("brown_conrady", (-0.2, 0.05, 0.001, -0.0005)),
    "kannala_brandt": Distortion("kannala_brandt", (0.03, -0.01, 0.002, -0.0005)),
}


def rendered(assets, lens):
    """An image of CAM_FRONT with the given distortion, and its camera."""
    rig = nuscenes_like_rig(320, 180)
    camera = replace(rig["CAM_FRONT"], distortion=lens)
    drive = RenderedDrive(113, frames=20, rig=CameraRig((camera,), rig.ego_from_bev), assets=assets, weather="noon")
    return drive.frame(9).images["CAM_FRONT"].astype(np.float64), camera


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_rendering_resembles_one_without_a_lens(assets, name):
    plain, _ = rendered(assets, None)
    bent, camera = rendered(assets, LENSES[name])
    mended = camera.undistort(bent.astype(np.uint8)).astype(np.float64)
    seen = mended.sum(-1) > 0  # black where the lens saw nothing
    assert seen.mean() > 0.85
    before, after = np.abs(bent - plain)[seen].mean(), np.abs(mended - plain)[seen].mean()
    assert after < 0.4 * before
