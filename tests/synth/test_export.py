"""`bevcli render` writes what the sequence reader reads, and says what is wrong in one line."""

from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from bevcli.cli.render import parse_resolution, render
from bevcli.errors import InputError, OutputError
from bevcli.sequences.native.calibration import write_calibration
from bevcli.sequences.open import open_sequence
from bevcli.synth.assets.catalog import Assets
from bevcli.synth.drive import RenderedDrive
from bevcli.synth.export import export_drive
from bevcli.synth.rig import nuscenes_like_rig


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, assets: Assets) -> tuple[RenderedDrive, Path]:
    folder = tmp_path_factory.mktemp("rendered") / "drive"
    drive = RenderedDrive(5, frames=2, rig=nuscenes_like_rig(160, 90), assets=assets)
    export_drive(drive, folder)
    return drive, folder


def test_the_reader_gives_back_what_was_rendered(written: tuple[RenderedDrive, Path]):
    drive, folder = written
    sequence = open_sequence(folder)
    assert [stamp.index for stamp in sequence.stamps] == [0, 1]
    read, rendered = sequence.load(1), drive.frame(1)
    assert read.stamp.timestamp_ns == rendered.stamp.timestamp_ns
    for name, image in rendered.images.items():
        assert np.abs(read.images[name].pixels_bgr.astype(int) - image).mean() < 4  # JPEG
    assert read.ground_truth is not None
    assert read.ground_truth_map is not None
    np.testing.assert_allclose(read.ground_truth.centers, rendered.boxes.centers, atol=1e-4)
    np.testing.assert_array_equal(read.ground_truth.num_points, rendered.boxes.num_points)
    np.testing.assert_array_equal(read.ground_truth_map.cells, rendered.bev_map.cells)
    np.testing.assert_allclose(read.world_from_ego.matrix, rendered.world_from_ego.matrix, atol=1e-9)


def test_ego_motion_is_denser_than_the_frames(written: tuple[RenderedDrive, Path]):
    rows = (written[1] / "ego_motion.csv").read_text().splitlines()
    assert rows[0].endswith("ax,ay,az,wx,wy,wz,vx,vy,vz")
    assert len(rows) - 1 == 26  # 0.5 s at 50 Hz, both ends


def test_a_second_export_gives_the_same_files(written: tuple[RenderedDrive, Path], tmp_path: Path, assets: Assets):
    export_drive(
        RenderedDrive(5, frames=2, rig=nuscenes_like_rig(160, 90), assets=assets, threads=2), tmp_path / "again"
    )
    names = sorted(p.relative_to(written[1]) for p in written[1].rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*") if p.is_file())
    for name in names:
        assert (written[1] / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_an_existing_sequence_is_not_overwritten(written: tuple[RenderedDrive, Path]):
    with pytest.raises(OutputError, match="exists already"):
        export_drive(written[0], written[1])


def test_the_command_renders_any_rig_at_any_size(tmp_path: Path):
    rig = nuscenes_like_rig(320, 180)
    write_calibration(tmp_path / "rig.json", type(rig)(rig.cameras[:2], rig.ego_from_bev))
    app = typer.Typer()
    app.command()(render)
    arguments = [str(tmp_path / "out"), "--seed", "4", "--frames", "1", "--rig", str(tmp_path / "rig.json")]
    result = CliRunner().invoke(app, [*arguments, "--resolution", "96x54", "--weather", "overcast"])
    assert result.exit_code == 0, result.output
    frame = open_sequence(tmp_path / "out").load(0)
    assert frame.rig.names == ("CAM_FRONT", "CAM_FRONT_RIGHT")
    assert frame.images["CAM_FRONT"].pixels_bgr.shape == (54, 96, 3)
    np.testing.assert_allclose(frame.rig["CAM_FRONT"].intrinsics[0, 0], 1266 * 96 / 1600)


def test_a_size_that_is_none_is_a_mistake_in_usage():
    assert parse_resolution("800x450") == (800, 450)
    for text in ("800", "x", "0x10", "800x99999"):
        with pytest.raises(typer.BadParameter):
            parse_resolution(text)


def test_a_lens_that_sees_behind_itself_is_refused(tmp_path: Path):
    from dataclasses import replace

    from bevcli.geometry.cameras import Distortion
    from bevcli.synth.rig import rig_for_rendering

    rig = nuscenes_like_rig(160, 90)
    camera = rig.cameras[0]
    wide = replace(
        camera,
        intrinsics=np.array([[45.0, 0, 80], [0, 45.0, 45], [0, 0, 1]]),
        distortion=Distortion("kannala_brandt", (0.0, 0.0, 0.0, 0.0)),
    )
    write_calibration(tmp_path / "rig.json", type(rig)((wide,), rig.ego_from_bev))
    with pytest.raises(InputError, match="camera CAM_FRONT: its lens sees too far"):
        rig_for_rendering(tmp_path / "rig.json", None)
