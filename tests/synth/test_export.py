"""`bevcli render` and its Python function: the files that they write, and their error messages."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from command_line import invoked

from bevcli.errors import InputError, OutputError
from bevcli.geometry.cameras import Distortion
from bevcli.geometry.transforms import apply
from bevcli.sequences.files.calibration_file import write_calibration
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.map_lines import LINE_CLASSES, LINES_FILE, read_lines
from bevcli.workshop.synth import Weather, parse_resolution
from bevcli.workshop.synth.drive import RenderedDrive, RenderedFrame, export_drive, render as render_sequence
from bevcli.workshop.synth.rig import nuscenes_like_rig, rig_for_rendering
from bevcli.workshop.synth.scenery import WEATHER_NAMES


def test_reading_the_folder_gives_the_rendered_frames(written: tuple[RenderedDrive, Path], rendered: RenderedFrame):
    sequence = open_sequence(written[1])
    lines = (written[1] / "ego_motion.csv").read_text().splitlines()
    assert lines[0].endswith("ax,ay,az,wx,wy,wz,vx,vy,vz")
    assert len(lines) - 1 == 26  # 0.5 s at 50 Hz, both ends included
    with pytest.raises(OutputError, match="exists already"):
        export_drive(written[0], written[1])
    assert [stamp.index for stamp in sequence.stamps] == [0, 1]
    read = sequence.load(1)
    assert sequence.facts.rendered
    assert read.stamp.timestamp_ns == rendered.stamp.timestamp_ns
    for name, image in rendered.images.items():
        assert np.abs(read.images[name].pixels_bgr.astype(int) - image).mean() < 4  # JPEG
    assert read.ground_truth is not None
    assert read.ground_truth_map is not None
    np.testing.assert_allclose(read.ground_truth.centers, rendered.boxes.centers, atol=1e-4)
    np.testing.assert_array_equal(read.ground_truth.num_points, rendered.boxes.num_points)
    np.testing.assert_array_equal(read.ground_truth_map.cells, rendered.bev_map.cells)
    np.testing.assert_allclose(read.world_from_ego.matrix, rendered.world_from_ego.matrix, atol=1e-9)


def test_true_lines_are_written_in_the_world_frame(written: tuple[RenderedDrive, Path], rendered: RenderedFrame):
    drive, folder = written
    lines = read_lines(folder / LINES_FILE)
    assert (lines.frame_of_reference, lines.classes, len(lines.frames)) == ("world", LINE_CLASSES, 2)
    world_from_bev = rendered.world_from_ego.matrix @ drive.rig.ego_from_bev
    assert len(lines.frames[1].lines) == len(rendered.lines) > 3
    for found, expected in zip(lines.frames[1].lines.points, rendered.lines.points, strict=True):
        at = apply(world_from_bev, np.pad(expected, ((0, 0), (0, 1))))
        np.testing.assert_allclose(found[:, :2], at[:, :2], atol=0.05)  # the bev frame is 1.84 m above the ground
    (read,) = open_sequence(folder).load(1).ground_truth_results
    for found, expected in zip(read.points, rendered.lines.points, strict=True):
        np.testing.assert_allclose(found, expected, atol=2e-3)  # files have millimetres


@pytest.mark.slow
def test_a_second_export_gives_the_same_files(written: tuple[RenderedDrive, Path], tmp_path: Path, assets):
    again = RenderedDrive(5, frames=2, rig=nuscenes_like_rig(160, 90), assets=assets, threads=2)
    export_drive(again, tmp_path)
    folders = tmp_path, written[1]
    files = [{path.relative_to(each): path.read_bytes() for path in each.rglob("*.*")} for each in folders]
    assert files[0] == files[1]


def test_the_command_renders_any_rig_at_any_size(tmp_path: Path):
    rig = nuscenes_like_rig(320, 180)
    write_calibration(tmp_path / "rig.json", replace(rig, cameras=rig.cameras[:2]))
    options = ["--seed", 4, "--count", 1, "--resolution", "96x54", "--weather", "overcast"]
    invoked("render", tmp_path / "out", "--rig", tmp_path / "rig.json", *options)
    frame = open_sequence(tmp_path / "out").load(0)
    assert frame.rig.names == ("CAM_FRONT", "CAM_FRONT_RIGHT")
    assert frame.images["CAM_FRONT"].pixels_bgr.shape == (54, 96, 3)
    np.testing.assert_allclose(frame.rig["CAM_FRONT"].intrinsics[0, 0], 1266 * 96 / 1600)


def test_resolutions_and_weathers_of_the_command():
    assert get_args(Weather) == WEATHER_NAMES
    assert parse_resolution("800x450") == (800, 450)
    for text in ("800", "x", "0x10", "800x99999"):
        with pytest.raises(ValueError, match="expected WxH"):
            parse_resolution(text)


def test_a_lens_too_wide_for_its_model_is_an_error(tmp_path: Path):
    rig = nuscenes_like_rig(160, 90)
    wide = Distortion("brown_conrady", (-0.3, 0.0, 0.0, 0.0))
    camera = replace(rig.cameras[0], intrinsics=np.array([[45.0, 0, 80], [0, 45.0, 45], [0, 0, 1]]), distortion=wide)
    write_calibration(tmp_path / "rig.json", replace(rig, cameras=(camera,)))
    with pytest.raises(InputError, match=r"rig\.json: camera CAM_FRONT: its field of view is too wide"):
        rig_for_rendering(tmp_path / "rig.json", None)


@pytest.mark.slow
def test_the_function_takes_a_rig_and_summarises_what_it_wrote(tmp_path: Path):
    rig = nuscenes_like_rig(96, 54)
    summary = render_sequence(tmp_path / "out", seed=4, frames=2, rig=replace(rig, cameras=rig.cameras[3:4]))
    sequence = open_sequence(summary.folder)
    assert summary.frames == len(sequence.stamps) == 2
    assert summary.cameras == sequence.load(0).rig.names == ("CAM_BACK",)
    assert summary.weather == RenderedDrive(4, frames=2).weather.name
    with pytest.raises(OutputError, match="exists already"):
        render_sequence(tmp_path / "out", frames=1, resolution=(96, 54))


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"frames": 0}, r"`frames=0` \(`--count`\): expected 1 or more"),
        ({"seed": -1}, r"`seed=-1` \(`--seed`\): expected 0 or more"),
        ({"rate_hz": 0.0}, r"`rate_hz=0\.0` \(`--rate`\): expected 0\.1 to 100"),
        ({"quality": 101}, r"`quality=101` \(`--quality`\): expected 1 to 100"),
        ({"resolution": (800, 8)}, r"`resolution=\(800, 8\)` \(`--resolution`\): expected 16 to 8192"),
        ({"supersampling": 5}, r"`supersampling=5` \(`--supersampling`\): expected 1 to 4"),
        ({"weather": "rain"}, "weather=rain` .*expected noon, evening, overcast"),
    ],
)
def test_an_argument_out_of_range_fails_before_any_writing(tmp_path: Path, argument, message):
    with pytest.raises(InputError, match=message):
        render_sequence(tmp_path / "out", **argument)
    assert not (tmp_path / "out").exists()
