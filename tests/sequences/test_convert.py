"""`bevcli convert`: the native folder has the same frames as the input."""

import os
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from command_line import invoked
from small_drive import CAMERAS, image_of

from bevcli.errors import BevcliError, InputError, OutputError
from bevcli.frame import BevMap
from bevcli.sequences.files.map_folder import write_map
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats import WriteOptions
from bevcli.workshop.formats.convert import open_writer
from bevcli.workshop.formats.output import NativeWriter


def convert(*arguments):
    return invoked("convert", *arguments)


def test_missing_images_and_camera_order_are_kept(edit, tmp_path):
    drive = edit("frames.csv", "images/CAM_BACK/1.png", "")
    convert(drive, tmp_path / "out")
    one, other = open_sequence(drive), open_sequence(tmp_path / "out")
    assert one.stamps == other.stamps
    for place in range(4):
        a, b = one.load(place), other.load(place)
        assert list(a.images) == list(b.images)
        assert a.dropped == b.dropped
        assert a.rig.names == b.rig.names
        for camera, image in a.images.items():
            assert image.encoded == b.images[camera].encoded
            one_pose, other_pose = (frame.world_from_ego_at[camera].matrix for frame in (a, b))
            np.testing.assert_allclose(one_pose, other_pose, atol=1e-9)
        np.testing.assert_allclose(a.kinematics.velocity, b.kinematics.velocity, atol=1e-12)


def test_ground_truth_maps_are_converted(drive, tmp_path):
    cells = np.random.default_rng(0).integers(0, 16, (20, 20), dtype=np.uint8)
    write_map(drive / "ground_truth_map", 11, BevMap(cells, (-10.0, 10.0), (-10.0, 10.0)))
    convert(drive, tmp_path / "out")
    sequence = open_sequence(tmp_path / "out")
    np.testing.assert_array_equal(sequence.load(1).ground_truth_map.cells, cells)
    assert sequence.load(0).ground_truth_map is None


def test_converted_drive_without_ego_motion_has_none(drive, tmp_path):
    (drive / "ego_motion.csv").unlink()
    convert(drive, tmp_path / "out")
    assert not (tmp_path / "out" / "ego_motion.csv").exists()
    with pytest.raises(InputError, match='`ego_motion="static"`'):
        open_sequence(tmp_path / "out")


def test_images_of_a_video_become_png(drive, edit, tmp_path):
    writer = cv2.VideoWriter(str(drive / "v.mkv"), cv2.VideoWriter_fourcc(*"FFV1"), 2, (64, 36))
    writer.write(image_of("CAM_BACK", 9))
    writer.release()
    edit("frames.csv", "images/CAM_BACK/2.png", "v.mkv#0")
    convert(drive, tmp_path / "out")
    written = tmp_path / "out" / "images" / "CAM_BACK" / "000012.png"
    np.testing.assert_array_equal(cv2.imread(str(written)), image_of("CAM_BACK", 9))


@pytest.mark.parametrize("form", ["native", "nuscenes", "mcap"])
def test_a_drive_without_a_readable_image_is_an_error(drive, tmp_path, form):
    shutil.rmtree(drive / "images")
    with pytest.raises(InputError, match=r"not one image could be read \(camera CAM_FRONT: "):
        convert(drive, out := tmp_path / ("out.mcap" if form == "mcap" else "out"), "--format", form)
    assert not out.exists()


def test_existing_folder_is_replaced_only_with_force(drive, tmp_path):
    out = tmp_path / "out"
    convert(drive, out)
    (out / "mine.txt").write_text("kept")
    (out / "images" / "CAM_FRONT" / "old.png").write_text("")
    with pytest.raises(OutputError, match="--force"):
        convert(drive, out)
    convert(drive, out, "--force")
    assert (out / "mine.txt").exists()
    assert not (out / "images" / "CAM_FRONT" / "old.png").exists()


@pytest.mark.parametrize("target", ["drive", "."])
def test_input_is_never_overwritten(drive, target):
    with pytest.raises(OutputError):
        convert(drive, drive.parent / target, "--force")
    assert open_sequence(drive).load(3).images


@pytest.mark.parametrize("ends", [("drive", "loop"), ("loop", "out")])
def test_a_link_to_itself_is_an_error(drive, ends):
    (drive.parent / "loop").symlink_to("loop")
    with pytest.raises(BevcliError):
        convert(*(drive.parent / end for end in ends))


@pytest.mark.parametrize("form", ["native", "nuscenes", "mcap"])
def test_an_interrupted_conversion_deletes_what_it_wrote(drive, tmp_path, form):
    mine = tmp_path / "kept/mine.txt"
    mine.parent.mkdir()
    mine.touch()
    sequence = open_sequence(drive)

    def write_and_end(out):
        with open_writer(out, sequence, WriteOptions(form, force=True)) as writer:
            writer.write(sequence.load(0))
            raise SystemExit(143)

    for out in (tmp_path / "new", mine.parent):
        with pytest.raises(SystemExit):
            write_and_end(out / "drive.mcap" if form == "mcap" else out)
    assert not any((tmp_path / "new").glob("*"))
    assert [*mine.parent.iterdir()] == [mine]


@pytest.mark.parametrize(("form", "part"), [("native", "images"), ("nuscenes", "samples")])
def test_a_forced_conversion_writes_through_no_link(drive, tmp_path, form, part):
    outside, out = tmp_path / "outside", tmp_path / "out"
    outside.mkdir()
    out.mkdir()
    (out / part).symlink_to(outside)
    convert(drive, out, "--force", "--format", form)
    assert not any(outside.iterdir())
    assert not (out / part).is_symlink()


def test_frames_that_no_folder_may_hold_are_not_written(drive, tmp_path):
    frame = open_sequence(drive).load(0)
    absurd = replace(frame, kinematics=replace(frame.kinematics, velocity=np.array([np.nan, 0.0, 0.0])))
    back = frame.rig["CAM_BACK"]
    moved = replace(back, ego_from_camera=back.ego_from_camera + [[0, 0, 0, 0.1], *[[0] * 4] * 3])
    other = replace(frame, rig=replace(frame.rig, cameras=(frame.rig.cameras[0], moved)))
    for frames, said in (([absurd], "is not written, because it could"), ([frame, other], "calibration differs from")):
        with pytest.raises(InputError, match=said), NativeWriter(tmp_path / "out", with_ego_motion=True) as writer:
            list(map(writer.write, frames))
    assert not (tmp_path / "out").exists()


def test_only_the_chosen_scene_is_converted(drive, tmp_path):
    lines = (drive / "frames.csv").read_text().splitlines()
    scenes = ["scene", "first", "first", "second", "second"]
    (drive / "frames.csv").write_text("\n".join(f"{s},{line}" for s, line in zip(scenes, lines, strict=True)))
    name, out = (os.fsdecode(each) for each in (b"in\xff\n\x1b[2J", b"out\xe2\x28\xa1"))  # names of any bytes
    convert(drive.rename(tmp_path / name), tmp_path / out, "--scene", "second")
    assert [stamp.index for stamp in open_sequence(tmp_path / out, scene="second").stamps] == [12, 13]


def test_intrinsics_in_yaml_make_a_calibration(drive, tmp_path):
    (drive / "calibration.json").rename(drive / "extrinsics.json")
    lines = [
        f"{name}: {{camera_model: pinhole, intrinsics: [50, 51, 31.5, 17.5], resolution: [64, 36]}}" for name in CAMERAS
    ]
    (drive / "camchain.yaml").write_text("\n".join(lines))
    options = ["--intrinsics", drive / "camchain.yaml", "--extrinsics", drive / "extrinsics.json"]
    convert(drive, tmp_path / "out", *options)
    rig = open_sequence(tmp_path / "out").load(0).rig
    np.testing.assert_allclose(rig["CAM_BACK"].intrinsics, [[50, 0, 31.5], [0, 51, 17.5], [0, 0, 1]])
