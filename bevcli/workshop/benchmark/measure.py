"""The benchmark: times every stage, and compares with the plain version and with the machine's peak throughput."""

import contextlib
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import torch

from bevcli.frame import Frame, Prediction
from bevcli.inference.background import WriteBehind
from bevcli.inference.load import Model
from bevcli.inference.machine import describe_machine, peak_memory
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import RunnerState
from bevcli.model.config import ModelConfig
from bevcli.model.prepare import Precision, prepare_for_inference
from bevcli.recording.writer import Recording
from bevcli.workshop.benchmark.limits import count_operations, measure_limits
from bevcli.workshop.benchmark.made_up import MadeUpDrive, made_up_model
from bevcli.workshop.benchmark.options import BenchOptions
from bevcli.workshop.benchmark.result import BenchmarkResult
from bevcli.workshop.benchmark.versions import Version, compare_with_plain

WARM_UP_FRAMES = 2  # one without and one with history
MIN_RUN_FRAMES = 4  # of a run with reading and recording; the times between them are measured, but for the last
RUN_FRAMES = 12  # of a run if frames are short
RUNS = 6  # that take turns with the model alone if frames are short
TURNS_S = 30.0  # for all turns if frames are short; with slow models one run


def run_benchmark(
    config: ModelConfig, device: torch.device, precision: Precision, options: BenchOptions, exported: Model | None
) -> BenchmarkResult:
    """Runs all measurements one after another. Nothing else should run on the machine.

    precision: of the prepared model. exported: an exported file of the model, which is timed with its own weights and
    precision; None for PyTorch.
    """
    limits = measure_limits(device, precision)
    model = made_up_model(config)
    network = prepare_for_inference(model, device, precision) if exported is None else exported.prepared
    fast = Version(network, device)
    first = config.past_frames
    timed, run = first + WARM_UP_FRAMES, first + WARM_UP_FRAMES + options.frames
    drive = MadeUpDrive(run + 2 * RUNS * max(options.frames, RUN_FRAMES))
    stages = _time_stages(fast, drive, first, range(timed, run))
    frame_s, peak = tuple(fast.seconds), peak_memory(device)
    run_frame_s, run_over_model = time_runs(fast, drive, run, max(options.frames, MIN_RUN_FRAMES))
    preprocessor = Preprocessor(config)
    prepared = preprocessor(drive.load(0))
    if options.profile is not None:
        with torch.profiler.profile() as profile:
            fast.step(prepared)
        profile.export_chrome_trace(str(options.profile))
    comparison = None
    if options.against == "plain":
        frames = (preprocessor(drive.load(place)) for place in range(options.frames))
        comparison, frame_s = compare_with_plain(model, fast, frames)
    size = (prepared.images.shape[-2], prepared.images.shape[-1])
    hits = model.pillars(prepared.image_from_bev, size, prepared.has_image)
    return BenchmarkResult(
        model=config.name,
        device=device.type,
        precision=precision if exported is None else exported.precision,
        engine="torch" if exported is None else exported.engine,
        machine=describe_machine(device),
        stages_s=stages,
        frame_s=frame_s,
        run_frame_s=run_frame_s,
        run_over_model=run_over_model,
        peak_memory_bytes=peak,
        operations=count_operations(config, hits.hits_per_camera),
        limits=limits.fastest(measure_limits(device, precision)),
        comparison=comparison,
    )


def _time_stages(fast: Version, drive: MadeUpDrive, first: int, timed: range) -> dict[str, tuple[float, ...]]:
    """Seconds of each stage of the timed frames, after a warm-up from frame `first` on; no two stages run together."""
    preprocessor = fast.runner.preprocessor()
    times: dict[str, list[float]] = defaultdict(list)
    with _recording(drive, fast) as recording:
        for place in range(first, timed.stop):
            if place == first + 1:
                fast.fill_past(drive)
            if place == timed.start:
                times.clear()
                fast.seconds = []
            began = time.perf_counter()
            frame = drive.load(place)
            loaded = time.perf_counter()
            prepared = preprocessor(frame)
            before = {"decode": loaded - began, "preprocess": time.perf_counter() - loaded}
            prediction = fast.step(prepared)
            recording_began = time.perf_counter()
            recording.log(frame, prediction)
            after = {"recording": time.perf_counter() - recording_began}
            for stage, seconds in {**before, **prediction.stage_seconds, **after}.items():
                times[stage].append(seconds)
    return {stage: tuple(seconds) for stage, seconds in times.items()}


def time_runs(
    fast: Version, drive: MadeUpDrive, place: int, frames: int, turns_s: float = TURNS_S
) -> tuple[float, float]:
    """Median seconds of a frame in whole runs, and how many times as long that is as a frame of the model alone.

    Both take turns, because the speed of a machine that others use changes within seconds. The frames of the drive are
    used once each, from `place` on; the model has seen those before.

    frames: of a run, at least. turns_s: of all turns if frames are short.
    """
    frame_s = median(fast.seconds)
    frames = max(frames, min(RUN_FRAMES, round(turns_s / RUNS / 2 / frame_s)))
    runs = max(1, min(RUNS, round(turns_s / (2 * frames * frame_s))))
    preprocessor = fast.runner.preprocessor()
    fast.seconds = []
    in_runs: list[float] = []
    with _recording(drive, fast) as recording:
        for first in range(place, place + 2 * frames * runs, 2 * frames):
            for alone in range(first, first + frames):
                fast.step(preprocessor(drive.load(alone)))
            in_runs += _time_run(fast, drive, range(first + frames, first + 2 * frames), preprocessor, recording)
    return median(in_runs), median(in_runs) / median(fast.seconds)


def _time_run(
    fast: Version, drive: MadeUpDrive, places: range, preprocessor: Preprocessor, recording: Recording
) -> list[float]:
    """Seconds of each frame while other threads read and record, as in `bevcli run`."""
    made: list[float] = []

    def record(step: tuple[Frame, Prediction, RunnerState[Any]]) -> bool:
        made.append(time.perf_counter())  # recording begins as soon as the model has made the step, or late
        recording.log(*step[:2])
        fast.state = step[2]
        return True

    with WriteBehind(record) as writer:
        for step in fast.runner.run(drive, places, preprocessor, fast.state):
            writer.put(step)
    return [after - before for before, after in pairwise(made[:-1])]  # beside the last frame none is read


@contextlib.contextmanager
def _recording(drive: MadeUpDrive, fast: Version) -> Iterator[Recording]:
    """A recording with the default options in a temporary folder."""
    folder = tempfile.TemporaryDirectory(prefix="bevcli-bench-")
    with folder, Recording(Path(folder.name) / "recording.rrd", drive, Model(fast.runner.model)) as recording:
        yield recording
