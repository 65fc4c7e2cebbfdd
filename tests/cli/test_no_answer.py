"""A disk that never answers ends the command in one line, although a thread still waits for it."""

import time
from pathlib import Path

from forks import FORKS, run_in_fork

from bevcli.sequences import images

SAMPLE = Path(__file__).parents[2] / "samples" / "street"


def hang() -> None:
    images.READING_TIMEOUT_S = 0.2
    images.ImageReader._read_one = lambda *arguments: time.sleep(3600)


def test_a_disk_that_does_not_answer_is_an_error_of_one_line(tmp_path):
    run = ["run", str(SAMPLE), "--frames", "0:1", "--out", "out"]
    process = FORKS.Process(target=run_in_fork, args=(tmp_path, run, "texts"), kwargs={"before": hang})
    process.start()
    process.join(240)
    assert process.exitcode == 1
    lines = [
        line for line in (tmp_path / "texts").read_text().splitlines() if not line.startswith(("note:", "opening "))
    ]
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    assert "reading the image: no answer within 0 s" in lines[0]
