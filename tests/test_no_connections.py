"""bevcli opens no connection of its own, and the viewer's telemetry is off."""

import sys
from pathlib import Path

import pytest
from command_line import command
from forks import FORKS, run_in_fork

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "samples" / "street"
CONNECTIONS = ("socket.connect", "socket.getaddrinfo", "socket.sendto", "socket.bind")


def watch() -> None:
    def report(event, arguments):
        # Connections of libcurl cause no events; it is imported for a download only.
        if event in CONNECTIONS or (event == "import" and arguments[0] == "pycurl"):
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


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("weights", "list"), "github.com"),
        (("weights", "list", "--json"), "github.com"),
        (("run", SAMPLE, "--model", "tiny"), "run `bevcli weights fetch tiny`, which downloads them"),
        (("batch", SAMPLE, "--model", "tiny-fp16", "--out", "out"), "run `bevcli weights fetch tiny-fp16`"),
        (("run", SAMPLE, "--model", "small"), "run `bevcli weights fetch small`"),
        (("reproduce", "tiny", "--data", SAMPLE), "is not a nuScenes root"),
    ],
    ids=lambda value: " ".join(map(str, value[:2])) if isinstance(value, tuple) else "",
)
def test_weights_are_never_fetched_without_being_asked(arguments, said, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "bevcli.workshop.weights.fetch", None)
    monkeypatch.setenv("BEVCLI_WEIGHTS_DIR", str(tmp_path))
    done = command(tmp_path, *arguments)
    assert said in done.stdout + done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_viewer_starts_without_telemetry():
    from bevcli.viewer.rerun_viewer import viewer_environment

    assert viewer_environment()["CI"] == "1"
