"""Workers on Ray: started on this machine for a batch, or those of a running cluster."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.util
import json
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bevcli.batch.drives import Drive
from bevcli.batch.job import Job
from bevcli.batch.worker import Record, Worker, use_threads
from bevcli.errors import BevcliError
from bevcli.pipeline.cpu_memory import keep_freed_memory
from bevcli.pipeline.cpu_threads import THREAD_SETTINGS

# Ray Data holds only one line of text per drive in its object store.
OBJECT_STORE_BYTES = 100 << 20
CONNECT_S = 15.0  # for the connection to a cluster
# Settings that Ray reads from the environment: no telemetry, no logs on the terminal.
_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_DATA_DISABLE_PROGRESS_BARS": "1",
    "RAY_DATA_LOG_LEVEL": "CRITICAL",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
}
# On this machine, Ray's processes then listen on 127.0.0.1 only.
_LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}


@dataclass(frozen=True)
class Workers:
    """How many workers there are, and what each of them may use.

    Attributes:
        count: number of workers; None: as many as the resources allow.
        threads: CPU threads of each; None: on this machine the cores divided by the workers, on a cluster 1.
        gpus: share of a GPU of each; None: 1 if there are GPUs and the job uses them, else 0.
        address: of a Ray cluster; None: this machine.
    """

    count: int | None = None
    threads: int | None = None
    gpus: float | None = None
    address: str | None = None


def is_installed() -> bool:
    """Whether Ray is installed."""
    return importlib.util.find_spec("ray") is not None


def run_on_ray(job: Job, job_hash: str, drives: Sequence[Drive], workers: Workers) -> Iterator[Record]:
    """Runs drives on Ray and yields their records as they are done.

    A worker that dies is replaced, and its drive is run again.

    Raises BevcliError where Ray is not installed or cannot be started, the cluster is lost, or a worker cannot load the
    model or write into the batch's folder.
    """
    if not is_installed():
        raise BevcliError("Ray is not installed: run pip install 'bevcli[ray]', or pass --workers 1")
    settings = _ENVIRONMENT if workers.address else _ENVIRONMENT | _LOOPBACK
    for name, value in settings.items():
        os.environ.setdefault(name, value)
    with _ray(workers) as ray:
        count, threads, gpus = _sizes(ray, job, workers, len(drives))
        if not gpus and job.device == "auto":
            job = dataclasses.replace(job, device="cpu")
        rows = [{"drive": json.dumps(dataclasses.asdict(drive))} for drive in drives]
        dataset = ray.data.from_items(rows, override_num_blocks=len(rows)).map_batches(
            _RayWorker,
            fn_constructor_kwargs={"job": job, "job_hash": job_hash, "threads": threads},
            compute=ray.data.ActorPoolStrategy(
                min_size=1, max_size=count, initial_size=count, max_tasks_in_flight_per_actor=1
            ),
            batch_size=1,
            num_cpus=threads,
            num_gpus=gpus,
        )
        try:
            for batch in dataset.iter_batches(batch_size=None, prefetch_batches=0):
                for text in batch["record"]:
                    yield _checked(json.loads(str(text)))
        except ray.exceptions.RayError as error:
            raise BevcliError(f"Ray stopped ({_first_line(error)}); `--resume` goes on") from None


class _RayWorker:
    """A `Worker` in the form that Ray Data calls: a batch of one drive in, its record out."""

    def __init__(self, job: Job, job_hash: str, threads: int) -> None:
        keep_freed_memory()
        use_threads(threads)
        self._worker: Worker | None = None
        self._problem = ""
        try:
            self._worker = Worker(job, job_hash)
        except BevcliError as error:  # an exception here would make Ray start the worker again and again
            self._problem = str(error)

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        record: Record = {"problem": self._problem}
        if self._worker is not None:
            try:
                record = self._worker.run(Drive(**json.loads(str(batch["drive"][0]))))
            except BevcliError as error:
                record = {"problem": str(error)}
        return {"record": np.array([json.dumps(record)])}


@contextlib.contextmanager
def _ray(workers: Workers) -> Iterator[Any]:
    """Ray, connected to the cluster or started for this batch: on the loopback interface, without dashboard."""
    import ray
    import ray.data

    ray_worker: Any = importlib.import_module("ray._private.worker")

    if workers.address is not None:
        _check_reachable(workers.address)
    local = {"num_cpus": _cores(), "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
    local |= {"object_store_memory": OBJECT_STORE_BYTES}
    options: dict[str, Any] = {"address": workers.address} if workers.address else {"address": "local", **local}
    on_terminate = signal.getsignal(signal.SIGTERM)
    try:
        with _without_stderr():
            environment = {"env_vars": THREAD_SETTINGS}
            ray.init(log_to_driver=False, logging_level=logging.ERROR, runtime_env=environment, **options)
    except Exception as error:  # Ray raises errors of many types where it cannot start or connect
        where = f"the cluster {workers.address} cannot be reached" if workers.address else "cannot be started"
        raise BevcliError(f"Ray: {where} ({_first_line(error)})") from None
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_terminate)  # Ray installs its own handler
    ray.data.DataContext.get_current().enable_progress_bars = False
    printing = ray_worker.print_to_stdstream
    # Ray prints on stdout that a worker died. The record of its drive says it, if it cannot be run at all.
    ray_worker.print_to_stdstream = lambda *_, **__: None
    try:
        yield ray
    finally:
        ray.shutdown()
        ray_worker.print_to_stdstream = printing


def _check_reachable(address: str) -> None:
    """Raises BevcliError where nothing listens at HOST:PORT; Ray would wait for minutes. "auto" is not checked."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        return
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise BevcliError(f"Ray: the cluster {address} cannot be reached ({_first_line(error)})") from None


@contextlib.contextmanager
def _without_stderr() -> Iterator[None]:
    """Discards what this process writes to stderr: Ray's C++ code reports its log level there."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _sizes(ray: Any, job: Job, workers: Workers, drives: int) -> tuple[int, int, float]:
    """Number of workers, and threads and GPUs of each. Raises BevcliError where there are too few resources."""
    resources = ray.cluster_resources()
    cores, gpus = int(resources.get("CPU", 0)), float(resources.get("GPU", 0))
    share = workers.gpus if workers.gpus is not None else float(gpus > 0 and job.device != "cpu")
    if share > gpus:
        raise BevcliError(f"--gpus-per-worker {share:g}: Ray has {gpus:g} GPUs: pass 0 to run on CPUs")
    count = workers.count
    if count is None:
        count = int(gpus / share) if share else cores // (workers.threads or 1)
    count = max(1, min(count, drives))
    threads = workers.threads or (1 if workers.address else max(1, cores // count))
    possible = min(cores // threads, int(gpus / share) if share else cores)
    if count > possible:
        raise BevcliError(
            f"{count} workers with {threads} threads and {share:g} GPUs each: Ray has {cores} cores and {gpus:g} GPUs: "
            f"pass --workers {max(1, possible)}"
        )
    return count, threads, share


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _checked(record: Record) -> Record:
    if record.get("problem"):
        raise BevcliError(str(record["problem"]))
    return record


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
