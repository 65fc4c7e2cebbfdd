"""The loop of `bevcli run`: each frame through the model, into the recording, the boxes file and the summary."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from bevcli.cli.progress import Progress
from bevcli.cli.run_summary import RunSummary
from bevcli.errors import OutputError
from bevcli.frame import Frame, Prediction, Sequence
from bevcli.pipeline.bev_files import save_bev
from bevcli.pipeline.model_loading import LoadedModel
from bevcli.pipeline.preprocess import Preprocessor
from bevcli.pipeline.runner import Runner, StepOptions
from bevcli.sequences.boxes_file import BoxesWriter, FrameBoxes
from bevcli.sequences.map_file import write_map
from bevcli.viz.options import RecordingOptions
from bevcli.viz.recording import Recording

UNTRAINED = "UNTRAINED: the weights are random, and so are the boxes"
MAPS = "segmentation"
OUTPUTS = ("recording.rrd", "predictions.json", "summary.json", "results_nusc.json", f"{MAPS}/map.json")


@dataclass(frozen=True)
class Job:
    """All that a run needs. chosen_cameras: camera -> the model's camera whose embedding it takes."""

    drive: Sequence
    loaded: LoadedModel
    device: torch.device
    step: StepOptions
    recording: RecordingOptions
    chosen_cameras: Mapping[str, str]
    out: Path
    save_bev: Path | None


def run_job(job: Job, *, force: bool) -> None:
    """Runs every frame; what is written is whole after each of them, whatever comes next."""
    prepare_folder(job.out, force=force)
    runner = Runner(job.loaded.model, job.device, job.step)
    summary = RunSummary(job)
    with contextlib.ExitStack() as stack:
        stack.callback(summary.write, job.out / "summary.json")
        recording = stack.enter_context(_recording(job))
        boxes = stack.enter_context(_boxes_writer(job))
        progress = stack.enter_context(Progress(len(job.drive.stamps), "frames"))
        for note in (*job.drive.notes, *([UNTRAINED] if job.loaded.untrained else [])):
            progress.message(f"note: {note}")
            recording.event(note, "WARN")
        places = range(len(job.drive.stamps))
        began = time.perf_counter()
        for frame, prediction, _ in runner.run(job.drive, places, Preprocessor(runner.config, job.chosen_cameras)):
            for warning in warnings(frame, prediction):
                progress.message(f"warning: {warning}")
            recording_began = time.perf_counter()
            recording.log(frame, prediction, prediction.attention)
            boxes.write(_frame_boxes(frame, prediction, world=job.drive.has_ego_motion))
            if prediction.segmentation is not None:
                write_map(job.out / MAPS, frame.stamp.index, prediction.segmentation)
            if job.save_bev is not None and prediction.bev is not None:
                save_bev(job.save_bev, prediction, {"model": runner.config.name, "untrained": job.loaded.untrained})
            now = time.perf_counter()
            summary.add(frame, prediction, recording_s=now - recording_began, whole_s=now - began)
            began = now
            progress.advance()
    print(summary.table(), file=sys.stdout)


def prepare_folder(out: Path, *, force: bool) -> None:
    """Makes the output folder; an earlier run's files are overwritten only if the user says so."""
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file (expected a folder to write to)")
    if out.exists() and any(out.iterdir()) and not force:
        raise OutputError(f"{out}: exists already; say --force to overwrite it, or --out DIR for another folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path in (*(out / name for name in OUTPUTS), *(out / MAPS).glob("[0-9]*.png")):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None


def warnings(frame: Frame, prediction: Prediction) -> list[str]:
    """What the person at the terminal should know of a frame; the recording logs its own events."""
    where = f"frame {frame.stamp.index}"
    found = [f"{where}: camera {camera} has no picture: {why}" for camera, why in frame.dropped.items()]
    if prediction.skipped:
        found.append(f"{where}: no picture at all; the state is passed on to the next frame")
    if prediction.started_anew.startswith("gap"):
        found.append(f"{where}: {prediction.started_anew}; the history starts anew")
    return found


def _recording(job: Job) -> Recording:
    config = job.loaded.model.config
    return Recording(
        job.out / "recording.rrd",
        rig=job.drive.rig,
        class_names=config.classes,
        title=f"{job.drive.name} · {config.name}",
        untrained=job.loaded.untrained,
        options=job.recording,
    )


def _boxes_writer(job: Job) -> BoxesWriter:
    config = job.loaded.model.config
    extras = {"model": config.name, "untrained": job.loaded.untrained, "classes": list(config.classes)}
    return BoxesWriter(job.out / "predictions.json", "world" if job.drive.has_ego_motion else "ego", extras)


def _frame_boxes(frame: Frame, prediction: Prediction, *, world: bool) -> FrameBoxes:
    extras: dict[str, object] = {"skipped": True} if prediction.skipped else {}
    if frame.sample_token is not None:
        extras["sample_token"] = frame.sample_token
    if world:
        return FrameBoxes(frame.stamp, frame.world_from_ego, prediction.boxes_world, extras)
    return FrameBoxes(frame.stamp, None, prediction.boxes_ego, extras)
