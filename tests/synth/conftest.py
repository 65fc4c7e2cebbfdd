"""What the tests of the rendered world share: the meshes, made once, and one small drive."""

import pytest

pytest.importorskip("numba")

from bevcli.synth.drive import Drive, RenderedFrame, Stock
from bevcli.synth.rig import nuscenes_like_rig


@pytest.fixture(scope="session")
def stock() -> Stock:
    return Stock.make()


@pytest.fixture(scope="session")
def drive(stock: Stock) -> Drive:
    """Seed 113: the ego vehicle brakes and turns right at a building site."""
    return Drive(113, frames=20, rig=nuscenes_like_rig(320, 180), stock=stock, weather="noon")


@pytest.fixture(scope="session")
def frame(drive: Drive) -> RenderedFrame:
    return drive.frame(9)
