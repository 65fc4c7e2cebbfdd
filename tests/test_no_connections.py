"""bevcli opens no connection of its own, and the viewer's telemetry is off."""

import sys
from pathlib import Path

from forks import FORKS, run_in_fork

SAMPLE = Path(__file__).parents[1] / "samples" / "street"
CONNECTIONS = ("socket.connect", "socket.getaddrinfo", "socket.sendto", "socket.bind")


def watch() -> None:
    def report(event, arguments):
        if event in CONNECTIONS:
            print("CONNECTION", event, arguments, file=sys.stderr)

    sys.addaudithook(report)


def test_a_run_opens_no_connection(tmp_path):
    run = ["run", str(SAMPLE), "--frames", "0:1", "--out", "out"]
    process = FORKS.Process(target=run_in_fork, args=(tmp_path, run, "texts"), kwargs={"before": watch})
    process.start()
    process.join(240)
    texts = (tmp_path / "texts").read_text()
    assert process.exitcode == 0, texts
    assert "CONNECTION" not in texts


def test_the_viewer_starts_without_telemetry():
    from bevcli.viewer.native import viewer_environment

    assert viewer_environment()["CI"] == "1"
