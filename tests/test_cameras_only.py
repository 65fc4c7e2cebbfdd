"""docs/cameras-only.md: its commands run on folders of numbered images and nothing else."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from command_line import MINI_TOML, command

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/cameras-only.md").read_text()
COMMANDS = [shlex.split(line) for line in re.findall(r"^bevcli (.+)$", PAGE, flags=re.MULTILINE)]


@pytest.fixture
def folder(tmp_path):
    """my_drive with two numbered images of each camera of the sample, and a small model."""
    for camera in sorted((ROOT / "samples/street/images").iterdir()):
        own = tmp_path / "my_drive" / camera.name.removeprefix("CAM_").lower()
        own.mkdir(parents=True)
        for index, image in enumerate(sorted(camera.iterdir())[:2]):
            shutil.copy(image, own / f"image_{index:04d}.jpg")
    (tmp_path / "demo.toml").write_text(MINI_TOML)
    return tmp_path


def test_the_page_is_one_screen():
    assert len(PAGE.splitlines()) <= 40
    assert [words[0] for words in COMMANDS] == ["project-debug", "run", "viz"]


@pytest.mark.slow
def test_the_commands_of_the_page_run(folder):
    debug, run, viz = COMMANDS
    done = command(folder, *debug)
    assert done.returncode == 0, done.stderr
    assert "my_drive: 6 cameras" in done.stdout
    assert (folder / "runs/my_drive-project-debug/cameras.png").exists()
    done = command(folder, *run, "--model", "demo.toml", "--untrained", "--out", "runs/my_drive-photographs")
    assert done.returncode == 0, done.stderr
    assert "numbered images at 2 Hz, none of 12 images missing" in done.stderr
    assert command(folder, *viz, "--summary").returncode == 0
