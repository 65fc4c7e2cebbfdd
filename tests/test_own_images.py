"""docs/own-images.md and docs/cameras-only.md: their commands run on folders as they describe."""

import csv
import json
import random
import re
import shlex
import shutil
from pathlib import Path

import pytest
import yaml
from command_line import MINI_TOML, command

from bevcli.sequences.open import open_sequence

ROOT = Path(__file__).parents[1]
OWN_IMAGES = (ROOT / "docs/own-images.md").read_text()
OWN_BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", OWN_IMAGES, flags=re.MULTILINE | re.DOTALL)
OWN_COMMANDS = [line for name, block in OWN_BLOCKS if name == "sh" for line in block.splitlines()]


@pytest.fixture
def my_drive(tmp_path):
    """The sample with folders of cameras and names in microseconds. Times are up to 4 ms off, and one image is lost.

    The calibration is in YAML, and the poses are a table in seconds.
    """
    street, drive = ROOT / "samples/street", tmp_path / "my_drive"
    drive.mkdir()
    cameras = {}
    for name, camera in json.loads((street / "calibration.json").read_text())["cameras"].items():
        pose = camera["ego_from_camera"]
        rows = [[*row, shift] for row, shift in zip(pose["rotation"], pose["translation"], strict=True)]
        stated = {"K": camera["intrinsics"], "D": [0, 0, 0, 0], "T": [*rows, [0, 0, 0, 1]]}
        cameras[name.removeprefix("CAM_").lower()] = stated
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(cameras, sort_keys=False))
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    rows = [f"time,{','.join(names)}"]
    for row in csv.DictReader((street / "ego_motion.csv").read_text().splitlines()):
        rows.append(
            ",".join([f"{row['timestamp_ns'][:-9]}.{row['timestamp_ns'][-9:]}", *(row[name] for name in names)])
        )
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    generator = random.Random(0)
    for row in csv.DictReader((street / "frames.csv").read_text().splitlines()):
        for camera in (name for name in row if name.startswith("CAM_") and "." not in name):
            time = int(row["timestamp_ns"]) // 1000 + generator.randint(-4000, 4000)
            folder = drive / camera.removeprefix("CAM_").lower()
            folder.mkdir(exist_ok=True)
            if (camera, row["frame"]) != ("CAM_BACK", "7"):
                prefix = "CAM_FRONT_" if camera == "CAM_FRONT" else ""
                shutil.copy(street / row[camera], folder / f"{prefix}{time}.jpg")
    return drive


def test_the_note_of_the_page_is_said_and_the_conversion_follows_it(my_drive, tmp_path):
    stated = {"calibration": tmp_path / "cameras.yaml", "ego_motion_file": tmp_path / "poses.csv"}
    one = open_sequence(my_drive, **stated)
    shown = next(block for name, block in OWN_BLOCKS if "note: " in block)
    shown = " ".join(shown.split()).removeprefix("note: ").removesuffix(" …")
    said = next(note for note in one.notes if note.startswith("frames.csv"))
    within = re.compile(r"within \d+ ms")
    assert within.sub("", said).startswith(within.sub("", shown))
    assert int(within.search(said)[0].split()[1]) <= 8
    done = command(tmp_path, *shlex.split(next(line for line in OWN_COMMANDS if "convert" in line))[1:])
    assert done.returncode == 0, done.stderr
    other = open_sequence(tmp_path / "my_sequence")
    assert (tmp_path / "my_sequence/frames.csv").exists()
    assert [stamp.timestamp_ns for stamp in one.stamps] == [stamp.timestamp_ns for stamp in other.stamps]
    for place in (0, 7):
        a, b = one.load(place), other.load(place)
        times = [{name: image.timestamp_ns for name, image in frame.images.items()} for frame in (a, b)]
        assert times[0] == times[1]
        assert all(image.encoded == b.images[name].encoded for name, image in a.images.items())
    assert list(b.dropped) == ["back"]


@pytest.mark.slow
def test_the_commands_of_the_page_run(my_drive, tmp_path):
    assert len(OWN_IMAGES.splitlines()) < 50
    for line in OWN_COMMANDS:
        program, *arguments = shlex.split(line)
        assert program == "bevcli"
        if arguments[0] != "viz":  # which opens a viewer
            done = command(tmp_path, *arguments)
            assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    assert (tmp_path / "runs/my_drive-photographs/recording.rrd").exists()


CAMERAS_ONLY = (ROOT / "docs/cameras-only.md").read_text()
CAMERAS_COMMANDS = [shlex.split(line) for line in re.findall(r"^bevcli (.+)$", CAMERAS_ONLY, flags=re.MULTILINE)]


@pytest.fixture
def numbered_images(tmp_path):
    """my_drive with two numbered images of each camera of the sample, and a small model."""
    for camera in sorted((ROOT / "samples/street/images").iterdir()):
        own = tmp_path / "my_drive" / camera.name.removeprefix("CAM_").lower()
        own.mkdir(parents=True)
        for index, image in enumerate(sorted(camera.iterdir())[:2]):
            shutil.copy(image, own / f"image_{index:04d}.jpg")
    (tmp_path / "demo.toml").write_text(MINI_TOML)
    return tmp_path


@pytest.mark.slow
def test_the_commands_of_cameras_only_run(numbered_images):
    debug, run, viz = CAMERAS_COMMANDS
    done = command(numbered_images, *debug)
    assert done.returncode == 0, done.stderr
    assert "my_drive: 6 cameras" in done.stdout
    assert (numbered_images / "runs/my_drive-project-debug/cameras.png").exists()
    done = command(numbered_images, *run, "--model", "demo.toml", "--untrained", "--out", "runs/my_drive-photographs")
    assert done.returncode == 0, done.stderr
    assert "numbered images at 2 Hz, none of 12 images missing" in done.stderr
    assert command(numbered_images, *viz, "--summary").returncode == 0
