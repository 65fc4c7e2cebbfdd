"""`bevcli viz`: its output and files, without a viewer."""

import csv
import json
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import invoked
from memory_drive import MemoryDrive, make_camera
from recorded_drive import NamedModel, bev_from_world, boxes_ahead, predict, record

from bevcli.errors import InputError, OutputError
from bevcli.geometry.boxes import Boxes2D
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import apply
from bevcli.recording import RecordingOptions
from bevcli.recording.writer import Recording
from bevcli.sequences.files.boxes_table import COLUMNS
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop import video
from bevcli.workshop.video import write_video


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "recording.rrd"
    return record(path, MemoryDrive(3)), path


def viz(*arguments) -> str:
    return invoked("viz", *arguments).output


def test_the_summary_counts_frames_boxes_and_bytes(drive):
    _, path = drive
    text = viz(path, "--summary")
    assert text.startswith(f"{path}: memory · tiny\n  frames    3, 1.00 s from 2001-09-09 01:46:40")
    assert f"  size      {path.stat().st_size / 1e6:.1f} MB\n  boxes     6\n          3 car\n          3 ped" in text
    assert text.count("/picture") == 6


def test_the_table_has_the_shown_boxes_in_the_world_frame(drive, tmp_path):
    frames, path = drive
    invoked("export", path, "--format", "csv", "--out", tmp_path / "boxes.csv")
    with (tmp_path / "boxes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert tuple(rows[0]) == COLUMNS  # those of boxes files
    cars = [row for row in rows if row["class"] == "car"]
    for frame, row in zip(frames, cars, strict=True):
        assert int(row["timestamp_ns"]) == frame.stamp.timestamp_ns
        center = apply(bev_from_world(frame), [float(row[axis]) for axis in "xyz"])
        np.testing.assert_allclose(center, boxes_ahead().centers[0], atol=2e-3)
        assert float(row["score"]) == pytest.approx(0.9)


def test_the_boxes_file_has_the_shown_boxes(drive, tmp_path):
    frames, path = drive
    invoked("export", path, "--format", "json", "--out", tmp_path / "boxes.json")
    content = json.loads((tmp_path / "boxes.json").read_text())
    assert (content["format"], content["frame_of_reference"]) == ("bevcli-boxes/1", "world")
    assert [frame["timestamp_ns"] for frame in content["frames"]] == [frame.stamp.timestamp_ns for frame in frames]
    assert [box["class"] for box in content["frames"][0]["boxes"]] == ["car", "pedestrian"]


@pytest.mark.parametrize(
    ("ending", "with_av", "codecs"),
    [("mp4", True, (b"h264", b"avc1")), ("mp4", False, (b"vp09", b"vp90")), ("webm", True, (b"vp90", b"vp09"))],
)
@pytest.mark.slow
def test_the_video_has_every_frame_and_the_boxes(drive, tmp_path, monkeypatch, ending, with_av, codecs):
    if with_av and not video.has_av():
        pytest.skip("PyAV is not installed: pip install 'bevcli[video]'")
    monkeypatch.setattr(video, "has_av", lambda: with_av)
    _, path = drive
    odd = Path(shutil.copytree(path.parent, tmp_path / "\udcff"), path.name)  # not UTF-8: OpenCV and rerun fail at it
    viz(odd, "--video", tmp_path / f"\udcff.{ending}")
    (tmp_path / f"\udcff.{ending}").rename(tmp_path / f"v.{ending}")
    written = cv2.VideoCapture(str(tmp_path / f"v.{ending}"))
    codec = int(written.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").lower()
    assert codec in codecs
    assert written.get(cv2.CAP_PROP_FPS) == pytest.approx(2.0)
    images = []
    while (read := written.read())[0]:
        images.append(read[1])
    assert len(images) == 3
    bev = images[0][:, -640:].astype(int)
    car = bev[320 - round(12 * 6.4) - 16 : 320 - round(12 * 6.4) + 16, 310:330]  # 12 m ahead, 6.4 pixels a metre
    assert (np.abs(car - [44, 158, 255]).sum(-1) < 120).any()  # the car's orange, BGR


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["webm", "mp4"])
def test_a_video_that_does_not_fit_is_an_error(drive, tmp_path, ending):
    """A limit on the size of files is what a full disk is to OpenCV, which tells neither."""
    path, before = tmp_path / f"video.{ending}", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_text("old")
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OutputError, match="cannot be written"):
            list(write_video(drive[1], path, 3, 2.0))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
def test_a_video_of_av1_images_shows_them(tmp_path):
    if not video.has_av():
        pytest.skip("PyAV is not installed: pip install 'bevcli[video]'")
    for images in ("jpeg", "av1"):
        record(tmp_path / f"{images}.rrd", MemoryDrive(2), RecordingOptions(images=images))
        viz(tmp_path / f"{images}.rrd", "--video", tmp_path / f"{images}.mp4")
    first = [cv2.VideoCapture(str(tmp_path / f"{name}.mp4")).read()[1][30:200, 20:400] for name in ("jpeg", "av1")]
    assert first[1].std() > 0.5 * first[0].std()


def test_folders_and_cut_recordings_are_shown_and_wrong_requests_told(drive, tmp_path):
    _, path = drive
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(path.read_bytes()[:-5000])
    assert viz(cut, "--summary").startswith(f"note: {cut} is incomplete")
    with pytest.raises(InputError, match="must end in"):
        viz(path, "--video", tmp_path / "x.avi")
    invoked("viz", path, "--frame", 1, "--summary", code=2)
    assert viz(path.parent, "--summary") == viz(path, "--summary")
    with pytest.raises(InputError, match=r"the folder has no recording\.rrd"):
        viz(tmp_path, "--summary")


def test_a_video_of_the_images_has_them_and_their_boxes_alone(tmp_path):
    """Two cameras of other sizes look ahead; at 40 frames a second. A car stands 12 m ahead."""
    cameras = (make_camera("LEFT", 20, 201, 120), make_camera("RIGHT", -20, 320, 180))
    rig, path = CameraRig(cameras, default_ego_from_bev()), tmp_path / "r.rrd"
    drive, person = MemoryDrive(3, rig=rig, step_s=1 / 40), np.array([[10.0, 10, 60, 100]])
    in_image = {"LEFT": Boxes2D(person, np.array(["person"]), np.array([0.9]))}
    with Recording(path, drive, NamedModel()) as recording:
        for frame in map(drive.load, range(3)):
            recording.log(frame, replace(predict(frame), image_boxes=in_image))
    viz(path, "--video", tmp_path / "v.mp4", "--view", "images")
    written = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert written.get(cv2.CAP_PROP_FPS) == pytest.approx(40)
    assert written.read()[1].shape == (180, 522, 3)  # 201 + 320, made even
    frame = next(RecordingReader(path).frames())
    images, layout = video.RecordedImages(), video.image_tiles(frame)
    canvas = video.draw_images(frame, layout, images)
    right = images.image(frame, "RIGHT")
    drawn = (canvas[:, 201:521] != right).any(-1)
    assert (canvas[:, 201:521][drawn] == (44, 158, 255)).all(-1).any()  # the car's orange, BGR
    assert drawn.mean() < 0.1
    assert not drawn[150:].any()
    assert (canvas[12:98, 10] != images.image(frame, "LEFT")[12:98, 10]).any(-1).all()  # what a detector sees
    assert "only valid with --video" in invoked("viz", path, "--view", "images", code=2).output
