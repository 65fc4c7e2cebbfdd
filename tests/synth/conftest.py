"""Fixtures of the rendered world: the meshes, built once, and two small drives."""

from pathlib import Path

import pytest

pytest.importorskip("numba")

from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.drive import RenderedDrive, RenderedFrame, export_drive
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


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory, assets: Assets) -> tuple[RenderedDrive, Path]:
    """Seed 5, and the folder that it is written into. Images of 160x90."""
    folder = tmp_path_factory.mktemp("rendered") / "drive"
    drive = RenderedDrive(5, frames=2, rig=nuscenes_like_rig(160, 90), assets=assets)
    export_drive(drive, folder)
    return drive, folder


@pytest.fixture(scope="session")
def rendered(written: tuple[RenderedDrive, Path]) -> RenderedFrame:
    return written[0].frame(1)
