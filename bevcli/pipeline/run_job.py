"""The loop of `bevcli run`: each frame through the model, into the files and the summary."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from bevcli.cli.progress import Progress
from bevcli.frame import Frame, Prediction, Sequence
from bevcli.model.prepared import prepare_for_inference
from bevcli.pipeline.model_loading import LoadedModel
from bevcli.pipeline.preprocess import Preprocessor
from bevcli.pipeline.run_files import RunFiles, prepare_folder
from bevcli.pipeline.run_summary import RunSummary
from bevcli.pipeline.runner import Runner, StepOptions
from bevcli.recording.options import RecordingOptions
from bevcli.recording.writer import LiveSink


@dataclass(frozen=True)
class Job:
    """All that a run needs.

    chosen_cameras: camera -> the model's camera whose embedding it takes. live: a viewer that follows the recording.
    """

    drive: Sequence
    loaded: LoadedModel
    device: torch.device
    step: StepOptions
    recording: RecordingOptions
    chosen_cameras: Mapping[str, str]
    out: Path
    save_bev: Path | None
    live: LiveSink | None = None


def run_job(job: Job, *, force: bool) -> None:
    """Runs every frame; what is written is whole after each of them, whatever comes next."""
    prepare_folder(job.out, force=force)
    runner = Runner(prepare_for_inference(job.loaded.model, job.device, job.step.precision), job.device, job.step)
    summary = RunSummary(job)
    places = range(len(job.drive.stamps))
    with contextlib.ExitStack() as stack:
        stack.callback(summary.write)
        files = stack.enter_context(RunFiles(job))
        progress = stack.enter_context(Progress(len(places), "frames"))
        for note in job.drive.notes:
            progress.message(f"note: {note}")
        if job.loaded.untrained:
            progress.message("note: the weights are UNTRAINED: random, and so are the boxes")
        if job.loaded.bundled:
            progress.message("note: these weights know rendered streets, not the real world (docs/model-card.md)")
        began = time.perf_counter()
        for frame, prediction, _ in runner.run(job.drive, places, Preprocessor(runner.config, job.chosen_cameras)):
            for warning in warnings(frame, prediction):
                progress.message(f"warning: {warning}")
            recording_began = time.perf_counter()
            files.write(frame, prediction)
            now = time.perf_counter()
            summary.add(frame, prediction, recording_s=now - recording_began, whole_s=now - began)
            began = now
            progress.advance()
    print(summary.table())


def warnings(frame: Frame, prediction: Prediction) -> list[str]:
    """What the person at the terminal should know of a frame; the recording logs its own events."""
    where = f"frame {frame.stamp.index}"
    found = [f"{where}: camera {camera} has no image: {why}" for camera, why in frame.dropped.items()]
    if prediction.skipped:
        found.append(f"{where}: no image at all; the state is passed on to the next frame")
    if prediction.started_anew.startswith("gap"):
        found.append(f"{where}: {prediction.started_anew}; the history starts anew")
    return found
