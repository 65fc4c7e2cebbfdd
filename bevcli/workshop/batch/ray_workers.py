"""Workers on Ray: started on this machine for a batch, or those of a running cluster."""

import contextlib
import dataclasses
import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from bevcli.errors import BevcliError
from bevcli.inference.cpu_settings import THREAD_SETTINGS, keep_freed_memory
from bevcli.printing import reason_of
from bevcli.workshop.batch.drives import Drive
from bevcli.workshop.batch.job import Job, Record
from bevcli.workshop.batch.options import Workers, ray_is_installed
from bevcli.workshop.batch.worker import Worker, use_threads

OBJECT_STORE_BYTES = 100 << 20  # it holds a drive and a record per worker
CONNECT_S = 15.0  # for the connection to a cluster
# Settings that Ray reads from the environment: no telemetry, and no messages on stdout, such as that a worker died. The
# record of its drive says it, if it cannot be run at all.
_ENVIRONMENT = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS_SKIP_REGEX": ".*"}
# On this machine, Ray's processes then listen on 127.0.0.1 only. Ray reads it once a process.
_LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}


def run_on_ray(job: Job, job_hash: str, drives: Sequence[Drive], workers: Workers) -> Iterator[Record]:
    """Run drives on Ray and yield their records as they are done.

    A worker that dies is replaced, and its drive is run again.

    Raises BevcliError where Ray is not installed or cannot be started, the cluster is lost, or a worker cannot load the
    model or write into the batch's folder.
    """
    if not ray_is_installed():
        raise BevcliError("Ray is not installed: run pip install 'bevcli[ray]', or pass `count=1`")
    if workers.address and _LOOPBACK.items() <= os.environ.items():
        raise BevcliError("Ray ran on this machine only in this process: use a new process for `address`")
    settings = _ENVIRONMENT if workers.address else _ENVIRONMENT | _LOOPBACK
    for name, value in settings.items():
        os.environ.setdefault(name, value)
    with _ray(workers) as ray:
        count, threads, gpus = _sizes(ray, job, workers, len(drives))
        if not gpus and job.model.device == "auto":
            job = dataclasses.replace(job, model=dataclasses.replace(job.model, device="cpu"))
        remote = ray.remote(num_cpus=threads, num_gpus=gpus, max_restarts=-1, max_task_retries=-1)(_RayWorker)
        idle = [remote.remote(job, job_hash, threads) for _ in range(count)]
        # Only a worker that has started gets a drive: a cluster may have no room for all of them yet.
        running = {worker.run.remote(None): worker for worker in idle}
        left, waiting = list(reversed(drives)), len(drives)
        try:
            while waiting:
                (done,), _ = ray.wait(list(running))
                worker, record = running.pop(done), ray.get(done)
                if record is not None:
                    if record.get("problem"):
                        raise BevcliError(str(record["problem"]))
                    waiting -= 1
                    yield record
                if left:
                    running[worker.run.remote(left.pop())] = worker
        except ray.exceptions.RayError as error:
            raise BevcliError(f"Ray stopped ({reason_of(error)[:200]}); `resume=True` goes on") from None


class _RayWorker:
    """A `Worker` in a process of Ray. A BevcliError is a record with its text as `problem`."""

    def __init__(self, job: Job, job_hash: str, threads: int) -> None:
        keep_freed_memory()
        use_threads(threads)
        self._make_worker = partial(Worker, job, job_hash)
        self._worker: Worker | None = None

    def run(self, drive: Drive | None) -> Record | None:
        """See `Worker.run`; None only loads the model."""
        try:  # not above: an exception there would make Ray start the worker again and again
            self._worker = self._worker or self._make_worker()
            return None if drive is None else self._worker.run(drive)
        except BevcliError as error:
            return {"problem": str(error)}


@contextlib.contextmanager
def _ray(workers: Workers) -> Iterator[Any]:
    """Ray, connected to the cluster or started for this batch: on the loopback interface, without dashboard."""
    import ray

    if workers.address is not None:
        _check_reachable(workers.address)
    options: dict[str, Any] = {"address": workers.address}
    if not workers.address:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        options = {"address": "local", "num_cpus": cores, "include_dashboard": False}
        options |= {"_node_ip_address": "127.0.0.1", "object_store_memory": OBJECT_STORE_BYTES}
    on_terminate = signal.getsignal(signal.SIGTERM)
    environment = {"env_vars": THREAD_SETTINGS}
    try:
        ray.init(log_to_driver=False, logging_level=logging.ERROR, runtime_env=environment, **options)
    except Exception as error:  # Ray raises errors of many types where it cannot start or connect
        where = f"the cluster {workers.address} cannot be reached" if workers.address else "cannot be started"
        raise BevcliError(f"Ray: {where} ({reason_of(error)[:200]}); `count=1` needs no Ray") from None
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_terminate)  # Ray installs its own handler
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raise BevcliError where nothing listens at HOST:PORT; Ray would wait for minutes. "auto" is not checked."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        return
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise BevcliError(f"Ray: the cluster {address} cannot be reached ({reason_of(error)[:200]})") from None


def _sizes(ray: Any, job: Job, workers: Workers, drives: int) -> tuple[int, int, float]:
    """Number of workers, and threads and GPUs of each. Raises BevcliError where there are too few resources."""
    resources = ray.cluster_resources()
    cores, gpus = int(resources.get("CPU", 0)), float(resources.get("GPU", 0))
    share = workers.gpus if workers.gpus is not None else float(gpus > 0 and job.model.device != "cpu")
    if share > gpus:
        raise BevcliError(f"`gpus={share:g}`: Ray has {gpus:g} GPUs: pass 0 to run on CPUs")
    count = workers.count
    if count is None:
        count = int(gpus / share) if share else cores // (workers.threads or 1)
    count = max(1, min(count, drives))
    threads = workers.threads or (1 if workers.address else max(1, cores // count))
    possible = min(cores // threads, int(gpus / share) if share else cores)
    if count > possible:
        raise BevcliError(
            f"{count} workers with {threads} threads and {share:g} GPUs each: Ray has {cores} cores and {gpus:g} GPUs: "
            f"pass `count={max(1, possible)}`"
        )
    return count, threads, share
