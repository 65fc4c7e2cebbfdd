"""`run_batch`: skip drives that are done, hand the others to workers, and write the tables and the report."""

import contextlib
import json
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from bevcli.errors import OutputError
from bevcli.inference.load import Model
from bevcli.recording.meshes import read_class_meshes
from bevcli.runs.folder import folder_lock
from bevcli.workshop.batch import Workers, storage
from bevcli.workshop.batch.job import BatchDrive, Job, Record, read_record
from bevcli.workshop.batch.report import write_results
from bevcli.workshop.batch.worker import StoppedError, Worker, run_on_ray

DESCRIPTION = "batch.json"  # says that a folder is a batch


@dataclass(frozen=True)
class BatchSummary:
    """Summary of a batch.

    Attributes:
        records: of all drives that are done or have failed, in the order of the drives.
        drives: number of drives of the batch.
        skipped: number of drives that were done or had failed before.
        stopped: before its end.
        files: paths or URLs of the files of the batch.
    """

    records: tuple[Record, ...]
    drives: int
    skipped: int
    stopped: bool
    files: tuple[str, ...]

    @property
    def failed(self) -> int:
        """Number of drives that have failed."""
        return sum(bool(record.get("error")) for record in self.records)

    def table(self) -> str:
        """The summary as a few aligned lines."""
        done = [record for record in self.records if not record.get("error")]
        classes: Counter[str] = Counter()
        for record in done:
            classes.update(record["boxes_by_class"])
        boxes = ", ".join(f"{count} {name}" for name, count in classes.most_common(4))
        before = f"; {self.skipped} were done or had failed before" if self.skipped else ""
        rows = [
            ("drives", f"{len(done)} of {self.drives} done, {self.failed} failed{before}"),
            ("frames", str(sum(record["frames"] for record in done))),
            ("boxes", f"{sum(classes.values())}" + (f" ({boxes})" if boxes else "")),
            *(("written", path) for path in self.files),
        ]
        return "\n".join(f"{name:<8} {text}" for name, text in rows)


def run_batch(
    job: Job,
    model: Model,
    drives: Sequence[BatchDrive],
    workers: Workers | None = None,
    *,
    resume: bool = False,
    retry_failed: bool = False,
    skipped: Callable[[int], None] = lambda count: None,
    after_drive: Callable[[Record], None] = lambda record: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> BatchSummary:
    """Run a model over many drives, each as `run_into_folder` does.

    The folder gets drives/NAME-HASH/ with the files of `bevcli run` for each drive, failed/NAME-HASH.json for each
    drive that failed, batch.parquet, batch.csv, report.html and, if drives were scored, metrics.json. The hash is that
    of a drive's input, the model, the weights and the options.

    Args:
        job: the model and the options.
        model: of `job.load_model`; with `workers` on any device.
        drives: of `find_drives`.
        workers: on Ray; None runs one drive after another in this process.
        resume: skip drives that are done or have failed, and go on with the others.
        retry_failed: run drives again that have failed.
        skipped: called once with the number of drives that are skipped.
        after_drive: called with the record of each drive that is done or has failed.
        should_stop: asked after each frame in this process; True ends the batch. KeyboardInterrupt ends it too.

    Raises:
        OutputError: the folder has a batch already, is in use by another one, or cannot be written.
        InputError: no drive has the format of an option, or the mesh of a class cannot be read.
        BevcliError: see `Worker` and `run_on_ray`.
    """
    job.check_options(drives)
    read_class_meshes(model.config.object_classes)  # each drive's recording needs them
    out, job_hash = storage.open_storage(job.out), job.hash(model)
    with folder_lock(out.path) if isinstance(out, storage.LocalFolder) else contextlib.nullcontext():
        _check_folder(out, resume)
        out.write(DESCRIPTION, json.dumps({"format": "bevcli-batch/1", "model": model.name}).encode())
        known = _known_records(out, drives, job_hash, retry_failed)
        skipped(len(known))
        for left in [name for name in out.names(storage.ATTEMPTS) if name.endswith(".run")]:  # of workers that died
            out.remove(f"{storage.ATTEMPTS}/{left}")
        pending = [drive for drive in drives if drive.result(job_hash) not in known]
        if retry_failed:
            for drive in pending:
                out.remove(f"{storage.ATTEMPTS}/{drive.result(job_hash)}.json")
        records, stopped = dict(known), False
        try:
            with contextlib.closing(_run(job, job_hash, model, pending, workers, should_stop)) as running:
                for record in running:
                    records[record["result"]] = record
                    after_drive(record)
        except (KeyboardInterrupt, StoppedError):
            stopped = True
            for name in out.names(storage.ATTEMPTS):  # an attempt that the user ended does not count
                out.remove(f"{storage.ATTEMPTS}/{name}")
        ordered = [records[name] for name in (drive.result(job_hash) for drive in drives) if name in records]
        files = write_results(out, ordered, model)
    return BatchSummary(tuple(ordered), len(drives), len(known), stopped, files)


def _run(
    job: Job,
    job_hash: str,
    model: Model,
    drives: Sequence[BatchDrive],
    workers: Workers | None,
    should_stop: Callable[[], bool],
) -> Generator[Record, None, None]:
    if not drives:
        return
    if workers is not None:
        yield from run_on_ray(job, job_hash, drives, workers)
        return
    worker = Worker(job, job_hash, model)
    for drive in drives:
        yield worker.run(drive, should_stop)
        if should_stop():
            raise StoppedError


def _check_folder(out: storage.Storage, resume: bool) -> None:
    """Raises OutputError unless the folder is new, or has a batch to go on with."""
    is_batch = out.read(DESCRIPTION) is not None
    found = out.names("") - {".bevcli"}
    if found and not is_batch:
        raise OutputError(f"{out.where}: is not a batch and not empty: pass `out` (`--out DIR`) for another folder")
    if is_batch and not resume and (out.names(storage.RESULTS) or out.names(storage.FAILED)):
        raise OutputError(
            f"{out.where}: has a batch already: pass `resume=True` (`--resume`) to go on with it, or `out` (`--out "
            "DIR`)"
        )


def _known_records(
    out: storage.Storage, drives: Sequence[BatchDrive], job_hash: str, retry_failed: bool
) -> dict[str, Record]:
    """The records of drives that are done or have failed, by the name of their results."""
    done, failed = out.names(storage.RESULTS), out.names(storage.FAILED)

    def find(result: str) -> Record | None:
        record = (
            read_record(out.read(f"{storage.RESULTS}/{result}/{storage.RECORD}"), result) if result in done else None
        )
        if record is None and not retry_failed and f"{result}.json" in failed:
            record = read_record(out.read(f"{storage.FAILED}/{result}.json"), result)
        return record

    results = [drive.result(job_hash) for drive in drives]
    with ThreadPoolExecutor(storage.READING_THREADS) as pool:
        found = zip(results, pool.map(find, results), strict=True)
        return {result: record for result, record in found if record is not None}
