"""bevcli opens no connection of its own, and the viewer's telemetry is off."""

import subprocess
import sys
from pathlib import Path

SAMPLE = Path(__file__).parents[1] / "samples" / "street"
WATCHED = """
import sys

def watch(event, arguments):
    if event in ("socket.connect", "socket.getaddrinfo", "socket.sendto", "socket.bind"):
        print("CONNECTION", event, arguments, file=sys.stderr)

sys.addaudithook(watch)
from bevcli.cli.main import run_app
run_app()
"""


def test_a_run_opens_no_connection(tmp_path):
    command = [sys.executable, "-c", WATCHED, "run", str(SAMPLE), "--frames", "0:1", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "CONNECTION" not in done.stderr


def test_the_viewer_starts_without_telemetry():
    from bevcli.viewer.native import viewer_environment

    assert viewer_environment()["CI"] == "1"
