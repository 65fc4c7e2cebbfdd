"""Fixtures of the rendered world: the meshes, built once, and one small drive."""

import pytest

pytest.importorskip("numba")

from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.drive import RenderedDrive, RenderedFrame
from bevcli.workshop.synth.rig import nuscenes_like_rig


@pytest.fixture(scope="session")
def assets() -> Assets:
    return Assets.build()


@pytest.fixture(scope="session")
def drive(assets: Assets) -> RenderedDrive:
    """Seed 113: the ego vehicle brakes and turns right at a building site. Images of 320x180."""
    return RenderedDrive(113, frames=20, rig=nuscenes_like_rig(320, 180), assets=assets, weather="noon")


@pytest.fixture(scope="session")
def frame(drive: RenderedDrive) -> RenderedFrame:
    return drive.frame(9)
