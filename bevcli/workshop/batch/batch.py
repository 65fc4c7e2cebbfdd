"""`batch` as a function with the options of the command as keywords."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bevcli.errors import InputError
from bevcli.inference.load import Model, choose_device, load_model
from bevcli.inference.options import ModelOptions
from bevcli.options import spread
from bevcli.recording.options import RecordingOptions
from bevcli.runs.options import RunOptions
from bevcli.sequences.format import option_classes
from bevcli.sequences.nuscenes import NuScenesOptions
from bevcli.sequences.options import InputOptions
from bevcli.workshop.batch import BatchOptions, Workers
from bevcli.workshop.batch.job import (
    BatchDrive,
    Job,
    Record,
    all_own_options,
    find_drives,
    read_list,
    with_absolute_paths,
)
from bevcli.workshop.batch.run_batch import BatchSummary, run_batch
from bevcli.workshop.batch.storage import is_url
from bevcli.workshop.batch.worker import use_threads

Load = Callable[[ModelOptions], Model]
OF_EXPORT = "the first drive of each number of cameras and image size exports the model, and waits for it"


@dataclass(frozen=True)
class PreparedBatch:
    """A batch before its first drive.

    Attributes:
        job: the model and the options.
        model: of the job.
        drives: of the batch.
        notes: for the user.
    """

    job: Job
    model: Model
    drives: list[BatchDrive]
    notes: tuple[str, ...]


def batch(
    drives: str | Path | Iterable[str | Path],
    out: str | Path,
    *,
    report: Callable[[str], None] = lambda note: None,
    after_drive: Callable[[Record], None] = lambda record: None,
    should_stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> BatchSummary:
    """Run a model on many drives, each as `run_into_folder` does, here or on Ray, as `bevcli batch` does.

        summary = bevcli.batch(["fleet/*"], "runs/fleet", model="tiny", evaluate=True, count=1)
        print(summary.table(), summary.failed)

    A drive that fails after all retries has its error in `summary.records`, and the others go on.

    Args:
        drives: sequence folders, nuScenes roots, folders of drives, patterns or URLs.
        out: folder or URL of the batch.
        report: called with notes.
        after_drive: called with the record of each drive that is done or has failed.
        should_stop: asked after each frame in this process; True ends the batch, which `resume` continues.
        options: those of `BatchOptions` (`resume`, `evaluate`, …), `Workers` (`count`, `gpus`, …), `ModelOptions`,
            `RunOptions`, `RecordingOptions` and `InputOptions`, and those of the formats.

    Raises BevcliError: see `run_batch`.
    """
    kinds = (BatchOptions, Workers, ModelOptions, RunOptions, RecordingOptions, InputOptions)
    chosen, workers, model, run_options, recording, source, own = spread(options | {"out": str(out)}, *kinds)
    names = {name for kind in option_classes() for name in kind.__dataclass_fields__}
    if own.keys() - names:
        raise TypeError(f"batch() has no option {min(own.keys() - names)}")
    if chosen.retry_failed and not chosen.resume:
        raise InputError("`retry_failed` (`--retry-failed`): is for `resume=True` (`--resume`)")
    texts = [drives] if isinstance(drives, str | Path) else list(drives)
    if "recording" not in options:
        run_options = replace(run_options, recording=recording)
    prepared = prepare_batch(list(map(str, texts)), chosen, workers, model, run_options, source, own)
    for note in prepared.notes:
        report(note)
    return run_batch(
        prepared.job,
        prepared.model,
        prepared.drives,
        None if workers.in_this_process else workers,
        resume=chosen.resume,
        retry_failed=chosen.retry_failed,
        after_drive=after_drive,
        should_stop=should_stop,
    )


def prepare_batch(
    texts: list[str],
    options: BatchOptions,
    workers: Workers,
    model: ModelOptions,
    run_options: RunOptions,
    source: InputOptions,
    own: dict[str, Any],
    load: Load = lambda options: load_model(options=options),
) -> PreparedBatch:
    """The job, model and drives of a batch. own: options of formats by name. load: loads the model."""
    texts = [*texts, *(read_list(options.listed) if options.listed else ())]
    job = Job(
        options.out if is_url(options.out) else str(Path(options.out.removeprefix("file://")).absolute()),
        with_absolute_paths(model),
        run=run_options,
        evaluate=options.evaluate,
        retries=workers.retries,
    )
    loaded = model_for_batch(job, workers, load, fetch=model.fetch)
    others = {name: value for name, value in own.items() if name != "split"}
    drives, notes = find_drives(texts, NuScenesOptions(own.get("version"), own.get("split")))
    if loaded.needs_export:
        notes = (*notes, OF_EXPORT)
    source = source.for_model(loaded.config, temporal=run_options.temporal)
    return PreparedBatch(replace(job, source=source, own=all_own_options(others)), loaded, drives, notes)


def model_for_batch(job: Job, workers: Workers, load: Load, *, fetch: bool = False) -> Model:
    """The model, loaded before the batch, so that a mistake in it ends the batch at once. Raises BevcliError.

    The batch needs its hash; only a worker in this process runs it. fetch: download weights that are missing.
    """
    alone, device = workers.in_this_process, job.model.device
    if alone and workers.threads is not None:
        use_threads(workers.threads)
    if alone and workers.gpus == 0 and device == "auto":
        device = "cpu"
    if workers.address is None:
        choose_device(device)
    return load(replace(job.model, device=device if alone else "cpu", fetch=fetch))
