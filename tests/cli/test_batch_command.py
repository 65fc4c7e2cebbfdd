"""`bevcli batch` as a command: exit codes, messages and the files that they name."""

import pytest
from command_line import MINI_TOML, command
from small_fleet import make_job, write_fleet

from bevcli.errors import BevcliError
from bevcli.workshop.batch import Workers, worker
from bevcli.workshop.batch.worker import run_on_ray


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("batch")
    (folder / "mini.toml").write_text(MINI_TOML)
    write_fleet(folder / "drives", 2, frames=1)
    return folder


def test_the_commands_end_with_what_they_wrote(place):
    (place / "list.txt").write_text("drives/d001\ndrives/missing\n")
    arguments = ("batch", "drives/d000", "--list", "list.txt", "--out", "out", "--model", "mini.toml", "--untrained")
    done = command(place, *arguments, "--workers", "1", "--retries", "0")
    assert done.returncode == 3, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "drives   2 of 3 done, 1 failed"
    assert [line.split()[-1] for line in lines if line.startswith("written")] == [
        str(place / "out" / name) for name in ("batch.parquet", "batch.csv", "report.html")
    ]
    assert f"failed: missing: {place}/drives/missing: is missing" in done.stderr
    assert "3/3 drives" in done.stderr


def test_mistakes_are_one_line(place):
    done = command(place, "batch", "drives/x*", "--out", "none", "--workers", "1")
    assert (done.returncode, done.stderr) == (1, "error: drives/x*: nothing matches this pattern (expected drives)\n")
    done = command(place, "batch", "drives/*", "--out", "none", "--model", "tiny", "--workers", "2")
    assert done.returncode == 1
    assert done.stderr.startswith("error: model tiny has no weights")
    assert not (place / "none").exists()


def test_a_cluster_needs_a_process_that_ran_no_local_batch(place, monkeypatch):
    monkeypatch.setattr(worker, "ray_is_installed", lambda: True)
    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # what a batch on this machine leaves
    with pytest.raises(BevcliError, match="use a new process for `address`"):
        next(run_on_ray(make_job(place / "none", place / "mini.toml"), "hash", [], Workers(address="10.0.0.1:6379")))


def test_several_workers_without_ray_name_what_to_install(place, monkeypatch):
    monkeypatch.setattr(worker, "ray_is_installed", lambda: False)
    with pytest.raises(BevcliError, match=r"run pip install 'bevcli\[ray\]', or pass `count=1`"):
        next(run_on_ray(make_job(place / "none", place / "mini.toml"), "hash", [], Workers(2)))
