"""`bevcli viz` of a drive: labels, and boxes of files against them; the commands of docs/compare.md."""

import contextlib
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
from command_line import command, invoked
from recorded_drive import screenshot_or_skip

import bevcli
from bevcli.cli import viewing
from bevcli.errors import InputError
from bevcli.recording import entities
from bevcli.recording.writer import Recording
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop.formats.nuscenes_output import write_submission

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


def viz(folder, line):
    """Raises the errors that the program prints."""
    with contextlib.chdir(folder):
        return invoked("viz", *shlex.split(line)).output


def test_boxes_are_recorded_against_the_labels(folder):
    text = viz(folder, "samples/street --boxes other.json --frames 0:1 --out one.rrd")
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
    text = viz(tmp_path, f"{root} --version v1.0-mini --frames 1: --boxes results_nusc.json --out r.rrd")
    assert "boxes of 1 of 3 frames, matched by sample_token; not in the drive: 1 further frame" in text
    first, later, _ = RecordingReader(tmp_path / "r.rrd").frames()
    assert len(first.texts(entities.BOXES, "name")) > 20
    assert first.texts(entities.MISSED, "name") == first.strips(entities.BEV_FALSE, "LineStrips2D:strips") == []
    assert not later.texts(entities.BOXES, "name")


def test_a_temporary_recording_is_shown_at_the_frame(folder, opened, monkeypatch):
    monkeypatch.setattr("bevcli.viewer.recording_file._check", lambda *_: None)  # takes a process
    viz(folder, "samples/street --frames 1:2 --frame 1")
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
        viz(folder, line)


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
    viz(folder, f"samples/street --boxes mine.json --boxes other.json --frames 0:1 --out {tmp_path}/two.rrd")
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
