"""Batches on Ray: dead workers, killed batches, object stores, and drives as `bevcli run` writes them."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_line import MINI_TOML, command, start
from small_fleet import results_of, write_drive, write_fleet

from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.output import NativeWriter
from bevcli.workshop.synth.drive import render

OPTIONS = ("--model", "mini.toml", "--untrained", "--rate", "all", "--score", "0", "--device", "cpu")
# One thread, as of the single runs: sums in another order are rounded otherwise.
BATCH = ("batch", "drives/*", "--out", "out", *OPTIONS, "--threads", "1")
# Looking for Ray takes less time than importing it where these tests are only collected.
pytestmark = [pytest.mark.slow, pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")]
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
two_workers = pytest.mark.skipif(CORES < 2, reason="this process may use one core only, and two workers need two")


@pytest.fixture(autouse=True)
def model_file(tmp_path):
    (tmp_path / "mini.toml").write_text(MINI_TOML)


def family_of(pid: int) -> dict[int, str]:
    """A process and all processes below it, with their command lines."""
    table = subprocess.run(["ps", "-e", "-o", "pid=,ppid=,args="], capture_output=True, text=True, check=True).stdout
    rows = [(int(row[0]), int(row[1]), row[2]) for row in (line.split(None, 2) for line in table.splitlines())]
    family = {pid}
    while more := {child for child, parent, _ in rows if parent in family} - family:
        family |= more
    return {child: args for child, _, args in rows if child in family}


def workers_of(process: subprocess.Popen) -> list[int]:
    """The processes of Ray's workers that run drives."""
    return [pid for pid, args in family_of(process.pid).items() if args.startswith("ray::") and "_RayWorker" in args]


def wait_for_results(process: subprocess.Popen, out: Path, count: int) -> None:
    deadline = time.monotonic() + 400
    while time.monotonic() < deadline:
        if (out / "drives").is_dir() and len(list((out / "drives").iterdir())) >= count:
            return
        if process.poll() is not None:
            break
        time.sleep(0.02)
    raise AssertionError(f"the batch ended before drive {count}: {process.communicate(timeout=10)}")


def cut(drive: Path, frames: slice, folder: Path) -> None:
    """Some frames of a drive as a drive."""
    sequence = open_sequence(drive, frames=frames)
    with NativeWriter(folder, with_ego_motion=True) as writer:
        for place in range(len(sequence.stamps)):
            writer.write(sequence.load(place))


def landed(out: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in (out / "drives").rglob("*") if path.is_file()}


@two_workers
@pytest.mark.timeout(1800)
def test_200_drives_with_a_killed_worker_and_a_killed_batch(tmp_path):
    for seed in range(6):  # six rendered drives of 66 frames, cut into 198
        long = tmp_path / f"rendered/{seed}"
        render(long, seed=seed, frames=66, resolution=(80, 45))
        for part in range(33):
            cut(long, slice(2 * part, 2 * part + 2), tmp_path / f"drives/d{33 * seed + part:03d}")
    (tmp_path / "drives/empty").mkdir()
    write_drive(tmp_path / "drives/corrupt", 500, frames=2)
    (tmp_path / "drives/corrupt/frames.csv").write_bytes(b"frame,\x00\xff")

    process = start(tmp_path, *BATCH, "--workers", "2")
    wait_for_results(process, tmp_path / "out", 20)
    assert len(workers_of(process)) == 2
    os.kill(workers_of(process)[0], signal.SIGKILL)  # Ray replaces it
    wait_for_results(process, tmp_path / "out", 100)
    process.kill()  # and the whole batch
    process.communicate(timeout=30)
    time.sleep(5)  # for its workers to notice
    before = landed(tmp_path / "out")
    done_before = len(results_of(tmp_path / "out"))
    failed_before = len(list((tmp_path / "out/failed").iterdir()))
    assert 100 <= done_before < 198

    resumed = command(tmp_path, *BATCH, "--workers", "2", "--resume")
    assert resumed.returncode == 3, resumed.stderr  # two drives failed
    assert f"198 of 200 done, 2 failed; {done_before + failed_before} were done or had failed before" in resumed.stdout
    after = landed(tmp_path / "out")
    assert {path: after[path] for path in before} == before  # nothing twice
    results = results_of(tmp_path / "out")
    assert len(results) == 198  # and nothing lost
    rows = {row["drive"]: row for row in pq.read_table(tmp_path / "out/batch.parquet").to_pylist()}
    assert len(rows) == 200
    assert {name for name, row in rows.items() if row["error"]} == {"corrupt", "empty"}
    assert not list((tmp_path / "out/.bevcli/attempts").iterdir())

    again = command(tmp_path, *BATCH, "--workers", "2", "--resume")
    assert "198 of 200 done, 2 failed; 200 were done or had failed before" in again.stdout
    assert landed(tmp_path / "out") == after

    loop = (
        "import sys; from bevcli.cli.main import app\n"
        "for name in sys.argv[1:]:\n"
        f"    app(['run', f'drives/{{name}}', '--out', f'alone/{{name}}', *{OPTIONS!r}], standalone_mode=False)\n"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    names = sorted(results)
    subprocess.run([sys.executable, "-c", loop, *names], cwd=tmp_path, env=environment, check=True, capture_output=True)
    for name in names:
        for file in ("predictions.json", "tracks.csv"):
            assert (results[name] / file).read_bytes() == (tmp_path / "alone" / name / file).read_bytes(), name


@two_workers
def test_ctrl_c_ends_a_batch_and_counts_no_attempt(tmp_path):
    write_fleet(tmp_path / "drives", 40, frames=4)
    process = start(tmp_path, *BATCH, "--workers", "2")
    wait_for_results(process, tmp_path / "out", 1)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=120)
    assert process.returncode == 130, stderr
    assert stderr.splitlines()[-1] == "stopped; `--resume` goes on with the drives that are left"
    assert "Traceback" not in stderr
    assert not list((tmp_path / "out/.bevcli/attempts").iterdir())
    assert (tmp_path / "out/batch.parquet").exists()


@two_workers
def test_a_drive_that_kills_its_worker_each_time_is_given_up(tmp_path):
    write_fleet(tmp_path / "drives", 4, frames=2)
    # What a worker imports at its start: a drive of this name ends the process without any exception.
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "def watch(event, arguments):\n"
        "    if event == 'open' and str(arguments[0]).endswith('d002/calibration.json') and 'default_worker' in "
        "' '.join(sys.orig_argv):\n"
        "        os.kill(os.getpid(), 9)\n"
        "sys.addaudithook(watch)\n"
    )
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "bevcli", *BATCH, "--workers", "2", "--retries", "1"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 3, done.stderr
    assert "3 of 4 done, 1 failed" in done.stdout
    assert "failed: d002: the worker died in attempt 2 of 2 (out of memory, or a crash)" in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stdout.splitlines()) == 6  # nothing of Ray's own
    assert not [line for line in done.stderr.splitlines() if ".cc:" in line or "raylet" in line], done.stderr


def test_a_worker_that_cannot_start_ends_the_batch_with_one_line(tmp_path):
    write_fleet(tmp_path / "drives", 2, frames=1)
    done = command(tmp_path, *BATCH, "--workers", "2", "--gpus-per-worker", "1")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: `gpus=1` (`--gpus-per-worker`): Ray has 0 GPUs")
    shutil.rmtree(tmp_path / "out")
    done = command(tmp_path, *BATCH, "--ray", "127.0.0.1:1")  # nothing listens there
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: Ray: the cluster 127.0.0.1:1 cannot be reached")


@pytest.fixture
def s3(tmp_path, monkeypatch):
    """An S3 server on this machine with the bucket "fleet"; the environment names it."""
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    monkeypatch.setenv("AWS_ENDPOINT_URL", url)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    server = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        wait_for_port(port, 60)
        import s3fs

        system = s3fs.S3FileSystem()
        system.mkdir("fleet")
        yield system
    finally:
        server.terminate()
        server.wait(20)


@two_workers
@pytest.mark.timeout(1200)
def test_drives_and_results_in_s3(s3, tmp_path):
    write_fleet(tmp_path / "drives", 3, frames=2, truth=True)
    s3.put(str(tmp_path / "drives") + "/", "fleet/drives/", recursive=True)
    arguments = ("batch", "s3://fleet/drives/*", "--out", "s3://fleet/out", *BATCH[4:], "--eval", "--workers", "2")
    done = command(tmp_path, *arguments)
    assert done.returncode == 0, done.stderr
    local = command(tmp_path, *BATCH, "--eval", "--workers", "1")
    assert local.returncode == 0, local.stderr
    s3.invalidate_cache()
    remote = {path.rpartition("/")[2].rpartition("-")[0]: path for path in s3.ls("fleet/out/drives", detail=False)}
    for name, folder in results_of(tmp_path / "out").items():
        assert s3.cat_file(f"{remote[name]}/predictions.json") == (folder / "predictions.json").read_bytes()
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert json.loads(s3.cat_file("fleet/out/metrics.json"))["tp_errors"] == metrics["tp_errors"]
    again = command(tmp_path, *arguments, "--resume")
    assert "3 of 3 done, 0 failed; 3 were done or had failed before" in again.stdout, again.stderr


def test_a_batch_runs_on_a_cluster_that_is_up_already(tmp_path, monkeypatch):
    write_fleet(tmp_path / "drives", 4, frames=2)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)  # workers get it from the batch
    port = free_port()
    cluster = subprocess.Popen(
        [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--port", str(port),
         "--num-cpus", "2", "--node-ip-address", "127.0.0.1", "--include-dashboard", "false", "--disable-usage-stats"],
        cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        wait_for_port(port, 120)
        batch = start(tmp_path, *BATCH, "--ray", f"127.0.0.1:{port}", "--workers", "2")
        _, errors = batch.communicate(timeout=240)
    finally:
        cluster.terminate()
        cluster.wait(60)
    assert batch.returncode == 0, errors
    command(tmp_path, *BATCH[:2], "--out", "alone", *BATCH[4:], "--workers", "1")
    alone = results_of(tmp_path / "alone")
    for name, folder in results_of(tmp_path / "out").items():
        assert (folder / "predictions.json").read_bytes() == (alone[name] / "predictions.json").read_bytes()
    assert len(alone) == 4


def wait_for_port(port: int, seconds: float) -> None:
    """Returns when something listens on a port of this machine, or after a time."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@two_workers
def test_a_local_batch_listens_on_this_machine_only(tmp_path):
    write_fleet(tmp_path / "drives", 6, frames=2)
    process = start(tmp_path, *BATCH, "--workers", "2")
    wait_for_results(process, tmp_path / "out", 1)
    inodes = inodes_below(process.pid)
    dashboards = [args for args in family_of(process.pid).values() if "dashboard/dashboard.py" in args]
    lines = [line for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()[1:]]
    addresses = {line.split()[1].partition(":")[0] for line in lines if listens(line) and line.split()[9] in inodes}
    process.communicate(timeout=400)
    ipv4, mapped, ipv6 = "0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"
    assert addresses
    assert not dashboards
    assert addresses <= {ipv4, mapped, ipv6}  # 127.0.0.1, the same as IPv6, ::1


def listens(line: str) -> bool:
    return line.split()[3] == "0A"


def inodes_below(pid: int) -> set[str]:
    """The sockets of a process and of all processes below it."""
    found = set()
    for member in family_of(pid):
        try:
            links = [os.readlink(path) for path in Path(f"/proc/{member}/fd").iterdir()]
        except OSError:
            continue
        found |= {link[8:-1] for link in links if link.startswith("socket:[")}
    return found
