"""A disk that never answers ends the command in one line, although a thread still waits for it."""

import subprocess
import sys
from pathlib import Path

SAMPLE = Path(__file__).parents[2] / "samples" / "street"
HANGING = """
import time
from bevcli.sequences import images

images.READING_TIMEOUT_S = 0.2
images.ImageReader._read_one = lambda *arguments: time.sleep(3600)
from bevcli.cli.main import run_app
run_app()
"""


def test_a_disk_that_does_not_answer_is_an_error_of_one_line(tmp_path):
    command = [sys.executable, "-c", HANGING, "run", str(SAMPLE), "--frames", "0:1", "--out", "out"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, timeout=240)
    assert done.returncode == 1
    lines = [line for line in done.stderr.splitlines() if not line.startswith("note:")]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    assert "reading the image: no answer within 0 s" in lines[0]
