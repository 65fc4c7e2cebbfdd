"""`bevcli viz` of recordings and of drives: output and files, without a viewer; the commands of docs/compare.md."""

import contextlib
import csv
import json
import re
import shlex
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import command, full_disk, invoked
from memory_drive import MemoryDrive, make_camera
from recorded_drive import bev_from_world, boxes_ahead, predict, record, recorded, screenshot_or_skip

import bevcli
from bevcli.cli import viewing
from bevcli.errors import InputError, OutputError
from bevcli.geometry.boxes import Boxes2D
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import apply
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.writer import Recording
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.sequences.files.boxes_table import COLUMNS
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop import video
from bevcli.workshop.formats.nuscenes_output import write_submission
from bevcli.workshop.video import draw_faded_strips, write_video


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
    if with_av:
        pytest.importorskip("av")
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
    """OpenCV does not tell that a disk is full."""
    path = tmp_path / f"video.{ending}"
    path.write_text("old")
    with full_disk(1000), pytest.raises(OutputError, match="cannot be written"):
        list(write_video(drive[1], path, 3, 2.0))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
def test_a_video_of_av1_images_shows_them(tmp_path):
    pytest.importorskip("av")
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
    steps = ((frame, replace(predict(frame), image_boxes=in_image)) for frame in map(drive.load, range(3)))
    frame, *_ = recorded(path, drive, steps)
    viz(path, "--video", tmp_path / "v.mp4", "--view", "images")
    written = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert written.get(cv2.CAP_PROP_FPS) == pytest.approx(40)
    assert written.read()[1].shape == (180, 522, 3)  # 201 + 320, made even
    images, layout = video.RecordedImages(), video.image_tiles(frame)
    canvas = video.draw_images(frame, layout, images)
    right = images.image(frame, "RIGHT")
    drawn = (canvas[:, 201:521] != right).any(-1)
    assert (canvas[:, 201:521][drawn] == (44, 158, 255)).all(-1).any()  # the car's orange, BGR
    assert drawn.mean() < 0.1
    assert not drawn[150:].any()
    assert (canvas[12:98, 10] != images.image(frame, "LEFT")[12:98, 10]).any(-1).all()  # what a detector sees
    assert "only valid with --video" in invoked("viz", path, "--view", "images", code=2).output


GREEN = 0x00FF0000  # RGB, without opacity


class Recorded:
    """One horizontal line on a row, with a colour."""

    def __init__(self, opacity: int) -> None:
        self.color = GREEN | opacity

    def strips(self, entity: str, component: str) -> list[np.ndarray]:
        return [np.array([[2.0, 5.0], [17.0, 5.0]])]

    def integers(self, entity: str, component: str) -> list[int]:
        return [self.color]


def green_of(opacity: int) -> int:
    canvas = np.full((11, 20, 3), 40, dtype=np.uint8)
    draw_faded_strips(canvas, Recorded(opacity), "lines", lambda points: points)
    return int(canvas[5, 10, 1])


def test_lines_in_videos_have_their_opacity():
    opaque = green_of(255)
    assert opaque > 200  # its edge is smoothed
    assert green_of(0) == 40  # invisible
    shares = [(green_of(opacity) - 40) / (opaque - 40) for opacity in (51, 128)]
    np.testing.assert_allclose(shares, [0.2, 0.5], atol=0.11)  # drawn in tenths


ROOT = Path(__file__).parents[2]
FRAMES = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the first frames of the sample, and boxes: mine.json has all labels, other.json the cars."""
    folder = tmp_path_factory.mktemp("folder")
    street = folder / "samples" / "street"
    shutil.copytree(ROOT / "samples" / "street", street)
    lines = (street / "frames.csv").read_text().splitlines()
    (street / "frames.csv").write_text("\n".join(lines[: 1 + FRAMES]))
    content = json.loads((street / "ground_truth.json").read_text())
    content["frames"] = content["frames"][:FRAMES]
    for box in (box for frame in content["frames"] for box in frame["boxes"]):
        box["score"] = 0.8
    (folder / "mine.json").write_text(json.dumps(content))
    for frame in content["frames"]:
        frame["boxes"] = [box for box in frame["boxes"] if box["class"] == "car"]
    (folder / "other.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def opened(monkeypatch):
    """The recordings that a viewer would show, with the frames where it opens; each is there at that time."""
    shown = []

    def open_viewer(recording, options):
        assert recording.stat().st_size > 100_000
        shown.append((recording, options.frame))

    monkeypatch.setattr(viewing, "_open_viewer", open_viewer)
    return shown


def viz_in(folder, line):
    """Raises the errors that the program prints."""
    with contextlib.chdir(folder):
        return invoked("viz", *shlex.split(line)).output


def test_boxes_are_recorded_against_the_labels(folder):
    text = viz_in(folder, "samples/street --boxes other.json --frames 0:1 --out one.rrd")
    assert (
        "other: has boxes of 1 of 1 frame, matched by scene and timestamp_ns; not in the drive: 2 further frames"
        in text
    )
    assert "one.rrd: 1 frame; next: bevcli viz one.rrd" in text
    [frame] = RecordingReader(folder / "one.rrd").frames()
    assert set(frame.texts(entities.BOXES, "name")) == {"car"}
    assert "pedestrian" in frame.texts(entities.MISSED, "name")
    assert "car" not in frame.texts(entities.MISSED, "name")
    assert "lane_boundary" in frame.texts(entities.RUN, "map_classes")


def test_a_submission_is_shown_on_a_nuscenes_root(shared, tmp_path):
    root = shared / "data/nuscenes-mini-4"
    drive = bevcli.open_sequence(root)
    frames = [drive.ground_truth_frame(place) for place in range(2)]
    stamped = [FrameBoxes(f.stamp, f.world_from_ego, f.ground_truth, {"sample_token": f.sample_token}) for f in frames]
    scored = [replace(each, boxes=replace(each.boxes, scores=np.ones(len(each.boxes)))) for each in stamped]
    write_submission(BoxesFile("world", tuple(scored)), tmp_path / "results_nusc.json")
    text = viz_in(tmp_path, f"{root} --version v1.0-mini --frames 1: --boxes results_nusc.json --out r.rrd")
    assert "boxes of 1 of 3 frames, matched by sample_token; not in the drive: 1 further frame" in text
    first, later, _ = RecordingReader(tmp_path / "r.rrd").frames()
    assert len(first.texts(entities.BOXES, "name")) > 20
    assert first.texts(entities.MISSED, "name") == first.strips(entities.BEV_FALSE, "LineStrips2D:strips") == []
    assert not later.texts(entities.BOXES, "name")


def test_a_temporary_recording_is_shown_at_the_frame(folder, opened, monkeypatch):
    monkeypatch.setattr("bevcli.viewer.recording_file._check", lambda *_: None)  # takes a process
    viz_in(folder, "samples/street --frames 1:2 --frame 1")
    [(recording, frame)] = opened
    assert frame == 1
    assert not recording.exists()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("mine.json", r"mine\.json: holds boxes .*: show them .*: `bevcli viz DRIVE --boxes mine\.json`"),
        ("run", r"run: holds boxes .*: `bevcli viz DRIVE --boxes run`"),
        ("x.rrd --boxes mine.json", r"x\.rrd: is a recording, and `boxes` \(`--boxes`\) is for a drive"),
        ("x.rrd --rate all", r"x\.rrd: is a recording, and `rate_hz` \(`--rate`\) is for a drive"),
        ("x.rrd --version v1.0-mini", r"x\.rrd: is a recording, and `version` \(`--version`\) is for a drive"),
        ("samples/street --boxes mine.json --boxes mine.json", "have the same name"),
        ("samples/street --boxes samples/street/ground_truth.json", 'boxes have no "score"'),
        ("samples/street --frame 99", "--frame 99: the drive has 3 frames from 0 to 2, and not this one"),
        ("samples/street --out x.json", r"x\.json: the file must end in \.rrd"),
    ],
)
def test_wrong_inputs_get_one_line(folder, line, message):
    (folder / "x.rrd").touch()
    (folder / "run").mkdir(exist_ok=True)
    shutil.copy(folder / "mine.json", folder / "run" / "predictions.json")
    shutil.copy(folder / "samples/street/calibration.json", folder / "run")
    with pytest.raises(InputError, match=message):
        viz_in(folder, line)


@pytest.mark.slow
def test_the_commands_of_the_page_run(folder, opened):
    page = (ROOT / "docs" / "compare.md").read_text()
    blocks = re.findall(r"^```(sh|python)\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    lines = [line for kind, block in blocks for line in block.splitlines() if kind == "sh" and line]
    assert len(lines) > 5
    for line in lines:
        program, *arguments = shlex.split(line, comments=True)
        assert program == "bevcli"
        done = command(folder, *arguments)
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    assert [frame for _, frame in opened] == [None, None, None, 2]
    [example] = [block for kind, block in blocks if kind == "python"]
    with contextlib.chdir(folder):
        exec(example, {})
    assert (folder / "labels.rrd").stat().st_size > 100_000


@pytest.mark.slow
def test_the_viewer_shows_both_models_and_a_tab_for_each(folder, tmp_path):
    viz_in(folder, f"samples/street --boxes mine.json --boxes other.json --frames 0:1 --out {tmp_path}/two.rrd")
    views = screenshot_or_skip(tmp_path / "two.rrd", tmp_path / "two.png")
    assert views.count("BEV") == views.count("3D scene") == views.count("CAM_FRONT") == 3
    assert "BEV features" not in views
    image = cv2.imread(str(tmp_path / "two.png"))[:, : round(0.7 * 1920)].astype(int)
    for own in entities.LAYER_COLORS:
        assert (np.abs(image - own[::-1]).sum(-1) < 40).sum() > 200


def test_a_recording_that_is_not_finished_leaves_the_old_one(folder, monkeypatch):
    (folder / "old.rrd").write_text("old")
    monkeypatch.setattr(Recording, "log", lambda *_: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        bevcli.record(bevcli.open_sequence(folder / "samples/street"), None, folder / "old.rrd")
    assert (folder / "old.rrd").read_text() == "old"
    assert not list(folder.glob("*unfinished*"))
