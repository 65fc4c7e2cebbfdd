"""docs/video.md: its commands run, on a video of the sample drive."""

import json
import re
import shlex
from pathlib import Path

import cv2
import pytest
from command_line import MINI_TOML, command

import bevcli

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/video.md").read_text()
COMMANDS = re.findall(r"^bevcli (.+)$", PAGE, flags=re.MULTILINE)
NUMBERS = ("--fov", "70", "--height", "1.4")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """dash.mp4 with three images of the front camera, and a small model in place of that of the page."""
    made = tmp_path_factory.mktemp("video")
    images = sorted((ROOT / "samples/street/images/CAM_FRONT").iterdir())[:3]
    writer = cv2.VideoWriter(str(made / "dash.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (800, 450))
    for path in images:
        writer.write(cv2.imread(str(path)))
    writer.release()
    (made / "demo.toml").write_text(MINI_TOML)
    return made


def test_the_video_runs_as_on_the_page(folder):
    [run] = [shlex.split(line) for line in COMMANDS if line.startswith("run ")]
    done = command(folder, *run, "--model", "demo.toml", "--untrained", "--out", "runs/dash-photographs", "--force")
    assert done.returncode == 0, done.stderr
    assert "without calibration: 1 camera" in done.stderr
    assert "no history is used" in done.stderr


@pytest.mark.slow
def test_the_video_is_checked_and_shown_as_on_the_page(folder):
    assert command(folder, *shlex.split(COMMANDS[0])).returncode == 0
    test_the_video_runs_as_on_the_page(folder)
    assert command(folder, *shlex.split(COMMANDS[-1]), "--summary").returncode == 0
    assert (folder / "runs/dash-project-debug/cameras.png").exists()


@pytest.mark.parametrize("name", ["run", "project-debug"])
def test_a_video_alone_is_told_in_one_line_what_is_missing(folder, name):
    model = ("--model", "demo.toml", "--untrained") if name == "run" else ()
    done = command(folder, name, "dash.mp4", *model)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "pass `fov_deg=70` (`--fov 70`) and `height=1.5` (`--height 1.5`), or `calibration`" in done.stderr
    if name == "run":  # a converted video has the rig that was stated
        done = command(folder, "convert", "dash.mp4", "drive", *NUMBERS)
        assert done.returncode == 0, done.stderr
        assert len(list((folder / "drive/images/dash").iterdir())) == 3
        assert '"translation": [1.7, 0.0, 1.4]' in (folder / "drive/calibration.json").read_text()


def test_a_video_is_one_camera_of_a_calibration_by_its_name(folder):
    (folder / "CAM_FRONT.mp4").write_bytes((folder / "dash.mp4").read_bytes())
    own = ROOT / "samples/street/calibration.json"
    stated = json.loads(own.read_text())["cameras"]
    other = folder / "rig.json"
    other.write_text(json.dumps({name: {**each, "K": each.pop("intrinsics")} for name, each in stated.items()}))
    for calibration in (own, other):
        drive = bevcli.open_sequence(folder / "CAM_FRONT.mp4", calibration=calibration, ego_motion="static")
        assert drive.load(2).images["CAM_FRONT"].pixels_bgr.shape == (450, 800, 3)
        with pytest.raises(bevcli.BevcliError, match="name the video after its camera"):
            bevcli.open_sequence(folder / "dash.mp4", calibration=calibration, ego_motion="static")
