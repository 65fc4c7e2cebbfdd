"""`batch`: a model over many drives. Skip those that are done, hand the others to workers, write tables and report."""

import contextlib
import json
from collections import Counter
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bevcli.errors import InputError, OutputError
from bevcli.inference import ModelOptions
from bevcli.inference.load import Model, choose_device, choose_model, load_model
from bevcli.options import defaults, spread
from bevcli.recording import RecordingOptions
from bevcli.runs import RunOptions
from bevcli.runs.state import folder_lock
from bevcli.sequences.format import formats
from bevcli.sequences.options import InputOptions
from bevcli.workshop.batch import BatchOptions, Workers, storage
from bevcli.workshop.batch.job import (
    BatchDrive,
    Job,
    Record,
    all_own_options,
    find_drives,
    read_list,
    read_record,
    with_absolute_paths,
)
from bevcli.workshop.batch.report import METRICS as METRICS, write_results
from bevcli.workshop.batch.worker import Worker, run_on_ray, use_threads
from bevcli.workshop.formats import NuScenesOptions
from bevcli.workshop.meshes import read_class_meshes

DESCRIPTION = "batch.json"  # says that a folder is a batch
OF_EXPORT = "the first drive of each number of cameras and image size exports the model, and waits for it"


def batch(
    drives: str | Path | Iterable[str | Path],
    out: str | Path,
    **options: Any,
) -> "BatchSummary":
    """Run a model on many drives, each as `run_into_folder` does, here or on Ray, as `bevcli batch` does.

        summary = bevcli.batch(["fleet/*"], "runs/fleet", model="tiny", evaluate=True, count=1)
        print(summary.table(), summary.failed)

    A drive that fails after all retries has its error in `summary.records`, and the others go on.
    `Batch` gives the loop; `summary.notes` has what `bevcli batch` prints at its start.

    Args:
        drives: sequence folders, nuScenes roots, folders of drives, patterns or URLs.
        out: folder or URL of the batch.
        options: those of `BatchOptions` (`resume`, `evaluate`, …), `Workers` (`count`, `gpus`, …), `ModelOptions`,
            `RunOptions`, `RecordingOptions` and `InputOptions`, and those of the formats.

    Raises BevcliError: see `Batch`.
    """
    kinds = (BatchOptions, Workers, ModelOptions, RunOptions, RecordingOptions, InputOptions)
    batch_options, workers, model, run_options, recording, input_options, format_values = spread(
        options | {"out": str(out)}, *kinds
    )
    names = {name for form in formats() for name in defaults(form)}
    if format_values.keys() - names:
        raise TypeError(f"batch() has no option {min(format_values.keys() - names)}")
    if batch_options.retry_failed and not batch_options.resume:
        raise InputError("`retry_failed` (`--retry-failed`): is for `resume=True` (`--resume`)")
    texts = [drives] if isinstance(drives, str | Path) else list(drives)
    if "recording" not in options:
        run_options = replace(run_options, recording=recording)
    job, found, notes = job_of(list(map(str, texts)), batch_options, workers, model, run_options, format_values)
    loaded = load_model(options=options_to_load(job, workers, fetch=model.fetch))
    prepared = prepare_batch(job, loaded, found, notes, batch_options, workers, input_options, format_values)
    for _ in prepared.run():
        pass
    return prepared.summary


def job_of(
    texts: Sequence[str],
    options: BatchOptions,
    workers: Workers,
    model: ModelOptions,
    run_options: RunOptions,
    format_values: Mapping[str, Any],
) -> tuple[Job, list[BatchDrive], tuple[str, ...]]:
    """The job of a batch, as far as it does not depend on the loaded model, its drives, and notes. Raises InputError.

    texts: drives, besides those of the list in the options.
    """
    texts = [*texts, *(read_list(options.listed) if options.listed else ())]
    drives, notes = find_drives(texts, NuScenesOptions(format_values.get("version"), format_values.get("split")))
    model, why = choose_model(model, [drive.source for drive in drives])
    out = options.out if storage.is_url(options.out) else str(Path(options.out.removeprefix("file://")).absolute())
    job = Job(out, with_absolute_paths(model), run=run_options, evaluate=options.evaluate, retries=workers.retries)
    return job, drives, (*why, *notes)


def options_to_load(job: Job, workers: Workers, *, fetch: bool = False) -> ModelOptions:
    """Options with which the model is loaded before the batch, so that a mistake in it ends the batch at once.

    The batch needs the hash of the model; only a worker in this process runs it. fetch: download weights that are
    missing. Raises BevcliError where a device is not there.
    """
    alone, device = workers.in_this_process, job.model.device
    if alone and workers.threads is not None:
        use_threads(workers.threads)
    if alone and workers.gpus == 0 and device == "auto":
        device = "cpu"
    if workers.address is None:
        choose_device(device)
    return replace(job.model, device=device if alone else "cpu", fetch=fetch)


def prepare_batch(
    job: Job,
    model: Model,
    drives: Sequence[BatchDrive],
    notes: tuple[str, ...],
    options: BatchOptions,
    workers: Workers,
    input_options: InputOptions,
    format_values: dict[str, Any],
) -> "Batch":
    """The batch of a job with its drives. format_values: options of formats by name. Raises InputError."""
    others = {name: value for name, value in format_values.items() if name != "split"}
    if model.needs_export:
        notes = (*notes, OF_EXPORT)
    input_options = input_options.for_model(model.config, temporal=job.run.temporal)
    job = replace(job, source=input_options, own=all_own_options(others))
    return Batch(job, model, drives, workers, notes, resume=options.resume, retry_failed=options.retry_failed)


@dataclass(frozen=True)
class BatchSummary:
    """Summary of a batch."""

    records: tuple[Record, ...]  # of all drives that are done or have failed, in the order of the drives
    drives: int  # number of drives of the batch
    skipped: int  # number of drives that were done or had failed before
    stopped: bool  # before its end
    files: tuple[str, ...]  # paths or URLs of the files of the batch
    notes: tuple[str, ...] = ()  # for the user

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


class Batch:
    """A model and many drives, each run as `run_into_folder` does.

    The folder gets drives/NAME-HASH/ with the files of `bevcli run` for each drive, failed/NAME-HASH.json for each
    drive that failed, batch.parquet, batch.csv, report.html and, if drives were scored, metrics.json. The hash is that
    of a drive's input, the model, the weights and the options.

    Attributes:
        drives: of `find_drives`.
        workers: their number, and the resources of each.
        notes: for the user.
        summary: of the batch, once it was run.
    """

    summary: BatchSummary

    def __init__(
        self,
        job: Job,
        model: Model,
        drives: Sequence[BatchDrive],
        workers: Workers = Workers(count=1),
        notes: tuple[str, ...] = (),
        *,
        resume: bool = False,
        retry_failed: bool = False,
    ) -> None:
        """Check what all drives need. Raises InputError: no drive has the format of an option, or a mesh is wrong.

        Args:
            job: the model and the options.
            model: of `job.load_model`; where workers on Ray run the drives, on any device.
            drives: of `find_drives`.
            workers: one drive after another in this process, or on Ray.
            notes: for the user.
            resume: skip drives that are done or have failed, and go on with the others.
            retry_failed: run drives again that have failed.
        """
        job.check_options(drives)
        read_class_meshes(model.config.object_classes)  # each drive's recording needs them
        self._job, self._model, self.drives, self.workers, self.notes = job, model, drives, workers, notes
        self._resume, self._retry_failed = resume, retry_failed

    def run(self) -> Generator[Record | int | None]:
        """Run the drives; yield first the number of those that are skipped, then the record of each other one.

        And None after each frame in this process. Closing it, and KeyboardInterrupt, stop the batch.

        Raises:
            OutputError: the folder has a batch already, is in use by another one, or cannot be written.
            BevcliError: see `Worker` and `run_on_ray`.
        """
        out, job_hash = storage.open_storage(self._job.out), self._job.hash(self._model)
        with folder_lock(out.path) if isinstance(out, storage.LocalFolder) else contextlib.nullcontext():
            _check_folder(out, self._resume)
            out.write(DESCRIPTION, json.dumps({"format": "bevcli-batch/1", "model": self._model.name}).encode())
            records = _earlier_records(out, self.drives, job_hash, self._retry_failed)
            skipped, stopped = len(records), False
            for name in [name for name in out.names(storage.ATTEMPTS) if name.endswith(".run")]:  # of dead workers
                out.remove(f"{storage.ATTEMPTS}/{name}")
            pending = [drive for drive in self.drives if drive.result(job_hash) not in records]
            if self._retry_failed:
                for drive in pending:
                    out.remove(f"{storage.ATTEMPTS}/{drive.result(job_hash)}.json")
            try:
                yield skipped
                with contextlib.closing(self._run(job_hash, pending)) as running:
                    for record in running:
                        if record is not None:
                            records[record["result"]] = record
                        yield record
            except (KeyboardInterrupt, GeneratorExit):
                stopped = True
                for name in out.names(storage.ATTEMPTS):  # an attempt that the user ended does not count
                    out.remove(f"{storage.ATTEMPTS}/{name}")
            results = [drive.result(job_hash) for drive in self.drives]
            ordered = tuple(records[result] for result in results if result in records)
            files = write_results(out, ordered, self._model)
        self.summary = BatchSummary(ordered, len(self.drives), skipped, stopped, files, self.notes)

    def _run(self, job_hash: str, drives: Sequence[BatchDrive]) -> Generator[Record | None]:
        if drives and not self.workers.in_this_process:
            yield from run_on_ray(self._job, job_hash, drives, self.workers)
        elif drives:
            worker = Worker(self._job, job_hash, self._model)
            for drive in drives:
                yield from worker.run(drive)


def _check_folder(out: storage.Storage, resume: bool) -> None:
    """Raises OutputError unless the folder is new, or has a batch to go on with."""
    is_batch = out.read(DESCRIPTION) is not None
    others = out.names("") - {".bevcli"}
    if others and not is_batch:
        raise OutputError(f"{out.where}: is not a batch and not empty: pass `out` (`--out DIR`) for another folder")
    if is_batch and not resume and (out.names(storage.RESULTS) or out.names(storage.FAILED)):
        raise OutputError(
            f"{out.where}: has a batch already: pass `resume=True` (`--resume`) to go on with it, or `out` (`--out "
            "DIR`)"
        )


def _earlier_records(
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
        pairs = zip(results, pool.map(find, results), strict=True)
        return {result: record for result, record in pairs if record is not None}
