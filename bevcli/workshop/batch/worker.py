"""Worker: runs one drive after another, each exactly as `bevcli run` does, and lands its results; here or on Ray."""

import contextlib
import json
import logging
import os
import shlex
import shutil
import signal
import socket
import tempfile
import threading
import time
import uuid
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import torch

from bevcli.errors import BevcliError
from bevcli.inference.load import Model
from bevcli.inference.machine import THREAD_SETTINGS, keep_freed_memory
from bevcli.parsing.files import is_there
from bevcli.printing import reason_of, valid_text
from bevcli.runs.run_into_folder import run_in_folder
from bevcli.runs.state import save_state
from bevcli.runs.summary import SUMMARY
from bevcli.sequences.format import format_of
from bevcli.workshop.batch import Workers, ray_is_installed, storage
from bevcli.workshop.batch.job import SCORE_BINS, BatchDrive, Job, Record, fetch_scene, read_record
from bevcli.workshop.batch.report import MATCHES, DriveMatches
from bevcli.workshop.formats import NuScenesOptions
from bevcli.workshop.scores.evaluate import Scores, evaluate
from bevcli.workshop.trust.estimate import agreement_of_boxes
from bevcli.writing import remove_abandoned

_SCRATCH = "bevcli-batch-"


class Worker:
    """Runs drives with a model that is loaded once. Raises BevcliError where the model or `out` cannot be used."""

    def __init__(self, job: Job, job_hash: str, model: Model | None = None) -> None:
        self._job, self._job_hash = job, job_hash
        self._out = storage.open_storage(job.out)
        self._model = job.load_model() if model is None else model
        remove_abandoned(Path(tempfile.gettempdir()), _SCRATCH)

    def run(self, drive: BatchDrive) -> Iterator[Record | None]:
        """Run a drive until it is done or has failed too often: yield None after each frame, then its stored record.

        An attempt is counted before it starts, so that a drive that kills its worker is not tried for ever.

        Raises OutputError if the batch's folder cannot be written.
        """
        result = drive.result(self._job_hash)
        done = read_record(self._out.read(f"{storage.RESULTS}/{result}/{storage.RECORD}"), result)
        if done is not None:  # Ray runs a drive again if it lost the answer of a worker
            yield done
            return
        marker = f"{storage.ATTEMPTS}/{result}.json"
        try:
            attempt, error = msgspec.json.decode(self._out.read(marker) or b'[0, ""]', type=tuple[int, str])
        except (msgspec.MsgspecError, ValueError, RecursionError):
            attempt, error = 0, ""
        while attempt <= self._job.retries:
            attempt += 1
            died = f"the worker died in attempt {attempt} of {self._job.retries + 1} (out of memory, or a crash)"
            self._out.write(marker, msgspec.json.encode((attempt, died)))
            try:
                record = yield from self._attempt(drive, result, attempt)
            except BevcliError as failure:
                error = str(failure)
            except Exception as failure:  # whatever one drive raises, the others go on
                reason = " ".join(str(failure).split())[:300]
                error = f"{type(failure).__name__}: {reason}" if reason else type(failure).__name__
                if self._model.device.type == "cuda":
                    try:
                        torch.zeros(1, device=self._model.device).cpu()
                    except RuntimeError:  # after some errors CUDA fails until the process is replaced
                        os._exit(1)
            else:
                self._out.remove(marker)
                yield record
                return
        record = {**_about(drive, result), "attempts": attempt, "error": valid_text(error)}
        self._out.write(f"{storage.FAILED}/{result}.json", json.dumps(record).encode())
        self._out.remove(marker)
        yield record

    def _attempt(self, drive: BatchDrive, result: str, attempt: int) -> Generator[None, None, Record]:
        if drive.problem:
            raise BevcliError(drive.problem)
        job, began = self._job, time.perf_counter()
        with self._scratch(result) as (aside, inputs):
            path = _fetched(drive, job, inputs)
            fetched = time.perf_counter()
            try:
                sequence = job.open(path, drive.scene)
                histogram = np.zeros(SCORE_BINS, dtype=np.int64)  # of the boxes that are shown
                model = self._model.in_engine(
                    sequence.rig, sequence, parts="`probes` (`--probe`)" if job.run.recording.probes else ""
                )
                with run_in_folder(model, sequence, aside, job.run, source=shlex.quote(drive.source)) as running:
                    for _, prediction in running.frames:
                        shown = prediction.boxes.shown(job.run.recording.score).scores
                        if shown is not None:
                            histogram += np.histogram(shown, SCORE_BINS, (0, 1))[0]
                        yield
                summary = running.summary
            except BevcliError as error:
                raise BevcliError(_with_final_paths(str(error), (path, drive.source), (aside, result))) from None
            seconds = time.perf_counter() - fetched
            scores, why_not = self._score(drive, path, aside)
            content: dict[str, Any] = summary.to_dict()
            agreement = {}
            if scores is None:
                found = agreement_of_boxes(aside, sequence)  # with the witness, which needs no ground truth
                values = {"agreement": found.score, "agreement_low": found.low, "agreement_high": found.high}
                agreement = {name: None if value is None else round(value, 4) for name, value in values.items()}
            record = {
                **_about(drive, result),
                "attempts": attempt,
                "error": "",
                **{name: content[name] for name in ("frames", "boxes", "boxes_by_class", "tracks")},
                **{name: len(content[name]) for name in ("dropped_images", "skipped_frames", "not_finite_frames")},
                "seconds": round(seconds, 3),
                "frames_per_second": round(summary.frames / seconds, 4),
                "fetch_seconds": round(fetched - began, 3),
                "output_bytes": sum(file.stat().st_size for file in aside.rglob("*") if file.is_file()),
                "score_histogram": histogram.tolist(),
                "scores": None if scores is None else _score_columns(scores),
                "not_scored": why_not,
                **agreement,
                "input_errors": "; ".join(summary.input_errors),
            }
            content = json.loads((aside / SUMMARY).read_text(encoding="utf-8"))
            final = f"{self._out.where}/{storage.RESULTS}/{result}"
            content["files"] = [_with_final_paths(name, (aside, final)) for name in content["files"]]
            (aside / SUMMARY).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            (aside / storage.RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
            landed = read_record(self._out.read(f"{storage.RESULTS}/{result}/{storage.RECORD}"), result)
            if landed is not None:
                return landed
            self._out.remove(f"{storage.FAILED}/{result}.json")
            self._out.land(aside, f"{storage.RESULTS}/{result}", storage.RECORD)
            return record

    def _score(self, drive: BatchDrive, path: Path, aside: Path) -> tuple[Scores | None, str]:
        """The scores of a drive's predictions, or None and why there are none; "" without ground truth."""
        input_format = format_of(path)
        if not self._job.evaluate or not (input_format.annotated or is_there(path / "ground_truth.json")):
            return None, ""
        version = self._job.own_of(NuScenesOptions).version if drive.scene else None
        class_map = self._job.source.class_map
        range_m = self._model.config.bev_grid.nearest_side_m
        try:
            scores = evaluate(aside, path, range_m, scene=drive.scene, version=version, class_map=class_map)
        except BevcliError as error:
            return None, _with_final_paths(str(error), (path, drive.source), (aside, "its results"))
        detection = scores.detection
        matches = DriveMatches(detection.frame_count, detection.matches, detection.unmeasured, scores.segmentation)
        save_state(aside / MATCHES, matches)
        return scores, ""

    @contextlib.contextmanager
    def _scratch(self, result: str) -> Iterator[tuple[Path, Path]]:
        """Folders for the results of an attempt and for a copy of its input; both are removed at the end.

        The results are written on the file system of the batch's folder, so that they can be moved at once.
        """
        inputs = Path(tempfile.gettempdir()) / f"{_SCRATCH}{os.getpid()}-{uuid.uuid4().hex[:8]}"
        aside = inputs / "result"
        if isinstance(self._out, storage.LocalFolder):
            attempts = self._out.path / storage.ATTEMPTS
            for abandoned in attempts.glob(f"{result}.*.run"):  # of a worker that died
                shutil.rmtree(abandoned, ignore_errors=True)
            aside = attempts / f"{result}.{uuid.uuid4().hex[:8]}.run"
        try:
            yield aside, inputs / "input"
        finally:
            shutil.rmtree(inputs, ignore_errors=True)
            shutil.rmtree(aside, ignore_errors=True)


def use_threads(count: int) -> None:
    """Set the number of CPU threads of this process."""
    torch.set_num_threads(count)
    cv2.setNumThreads(count)


def _about(drive: BatchDrive, result: str) -> Record:
    return {"drive": drive.name, "source": valid_text(drive.source), "scene": drive.scene, "result": result}


def _score_columns(scores: Scores) -> Record:
    table = scores.detection.overall.of_classes_with_ground_truth()
    numbers = {"mean_ap": table.mean_ap, "nd_score": table.nd_score, **table.errors}
    if scores.segmentation is not None:
        numbers |= {f"iou_{name}": value for name, value in scores.segmentation.iou.items()}
    defined = {name: None if np.isnan(value) else round(value, 6) for name, value in numbers.items()}
    return {**defined, "ground_truth_boxes": scores.detection.overall.ground_truth_count}


def _fetched(drive: BatchDrive, job: Job, inputs: Path) -> Path:
    """A local path of a drive's input; of a URL, a copy with the same name."""
    if not storage.is_url(drive.source):
        return Path(drive.source)
    local = inputs / drive.source.rpartition("/")[2]
    if drive.scene is None:
        storage.RemoteFolder(drive.source).fetch(local)
    else:
        fetch_scene(drive.source, job.own_of(NuScenesOptions), drive.scene, local)
    return local


def _with_final_paths(message: str, *pairs: tuple[Path, str]) -> str:
    """An error message with the names that the user knows in place of temporary paths."""
    for path, name in pairs:
        message = message.replace(str(path), name)
    return message


OBJECT_STORE_BYTES = 100 << 20  # it holds a drive and a record per worker
CONNECT_S = 15.0  # for the connection to a cluster
# Settings that Ray reads from the environment: no telemetry, and no messages on stdout, such as that a worker died. The
# record of its drive says it, if it cannot be run at all.
_ENVIRONMENT = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS_SKIP_REGEX": ".*"}
# On this machine, Ray's processes then listen on 127.0.0.1 only. Ray reads it once a process.
_LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}


def run_on_ray(job: Job, job_hash: str, drives: Sequence[BatchDrive], workers: Workers) -> Iterator[Record]:
    """Run drives on Ray and yield their records as they are done.

    A worker that dies is replaced, and its drive is run again.

    Raises BevcliError where Ray is not installed or cannot be started, the cluster is lost, or a worker cannot load the
    model or write into the batch's folder.
    """
    if not ray_is_installed():
        raise BevcliError("Ray is not installed: run pip install 'bevcli[ray]', or pass `count=1` (`--workers 1`)")
    if workers.address and _LOOPBACK.items() <= os.environ.items():
        raise BevcliError("Ray ran on this machine only in this process: use a new process for `address` (`--ray`)")
    settings = _ENVIRONMENT if workers.address else _ENVIRONMENT | _LOOPBACK
    for name, value in settings.items():
        os.environ.setdefault(name, value)
    with _ray(workers) as ray:
        count, threads, gpus = _sizes(ray, job, workers, len(drives))
        if not gpus and job.model.device == "auto":
            job = replace(job, model=replace(job.model, device="cpu"))
        remote = ray.remote(num_cpus=threads, num_gpus=gpus, max_restarts=-1, max_task_retries=-1)(_RayWorker)
        idle = [remote.remote(job, job_hash, threads) for _ in range(count)]
        # Only a worker that has started gets a drive: a cluster may have no room for all of them yet.
        running = {worker.run.remote(None): worker for worker in idle}
        pending, waiting = list(reversed(drives)), len(drives)
        try:
            while waiting:
                (done,), _ = ray.wait(list(running))
                worker, record = running.pop(done), ray.get(done)
                if record is not None:
                    if record.get("problem"):
                        raise BevcliError(str(record["problem"]))
                    waiting -= 1
                    yield record
                if pending:
                    running[worker.run.remote(pending.pop())] = worker
        except ray.exceptions.RayError as error:
            raise BevcliError(f"Ray stopped ({reason_of(error)[:200]}); `resume=True` (`--resume`) goes on") from None


class _RayWorker:
    """A `Worker` in a process of Ray. A BevcliError is a record with its text as `problem`."""

    def __init__(self, job: Job, job_hash: str, threads: int) -> None:
        keep_freed_memory()
        use_threads(threads)
        self._make_worker = partial(Worker, job, job_hash)
        self._worker: Worker | None = None

    def run(self, drive: BatchDrive | None) -> Record | None:
        """See `Worker.run`; None only loads the model."""
        try:  # not above: an exception there would make Ray start the worker again and again
            self._worker = self._worker or self._make_worker()
            for record in () if drive is None else self._worker.run(drive):
                if record is not None:
                    return record
            return None
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
        reason = f"the cluster {workers.address} cannot be reached" if workers.address else "cannot be started"
        raise BevcliError(f"Ray: {reason} ({reason_of(error)[:200]}); `count=1` (`--workers 1`) needs no Ray") from None
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
        raise BevcliError(f"`gpus={share:g}` (`--gpus-per-worker`): Ray has {gpus:g} GPUs: pass 0 to run on CPUs")
    count = workers.count
    if count is None:
        count = int(gpus / share) if share else cores // (workers.threads or 1)
    count = max(1, min(count, drives))
    threads = workers.threads or (1 if workers.address else max(1, cores // count))
    possible = min(cores // threads, int(gpus / share) if share else cores)
    if count > possible:
        raise BevcliError(
            f"{count} workers with {threads} threads and {share:g} GPUs each: Ray has {cores} cores and {gpus:g} GPUs: "
            f"pass `count={max(1, possible)}` (`--workers {max(1, possible)}`)"
        )
    return count, threads, share
