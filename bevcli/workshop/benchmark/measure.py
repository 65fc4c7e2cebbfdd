"""The benchmark: times every stage, and compares with the plain version and with the machine's peak throughput."""

import contextlib
import math
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from bevcli.frame import Frame, Prediction
from bevcli.inference.background import write_behind
from bevcli.inference.load import Model
from bevcli.inference.machine import describe_machine, peak_memory
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import RunnerState
from bevcli.model.config import ModelConfig
from bevcli.model.network import build_network
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.prepare import DTYPES, Precision
from bevcli.recording.writer import Recording
from bevcli.workshop.benchmark.made_up import MadeUpDrive, made_up_model
from bevcli.workshop.benchmark.result import BenchmarkResult, MachineLimits
from bevcli.workshop.benchmark.versions import Version, compare_with_plain, wait_for

WARM_UP_FRAMES = 2  # one without and one with history
MIN_RUN_FRAMES = 4  # of a run with reading and recording; the times between them are measured, but for the last
RUN_FRAMES = 12  # of a run if frames are short
RUNS = 6  # that take turns with the model alone if frames are short
TURNS_S = 30.0  # for all turns if frames are short; with slow models one run
# Edge of the square matrices and floats of the copied block: large enough for full speed, small enough to be quick.
CPU_EDGE, GPU_EDGE = 2048, 8192
COPIED_FLOATS = 1 << 26
REPEATS = 8

# Bilinear sampling: a product and a sum for each of four neighbours, then a product and a sum with the weight.
OPERATIONS_PER_SAMPLE = 4 * 2 + 2


def run_benchmark(
    model: Model, frames: int, *, against_plain: bool = False, profile_path: Path | None = None
) -> BenchmarkResult:
    """Run all measurements one after another. Nothing else should run on the machine.

    Args:
        model: with made-up weights; or an exported file, which is timed with its own weights and precision.
        frames: number of timed frames.
        against_plain: compare with the plain version.
        profile_path: where PyTorch's profile of one frame is written; None for no profile.
    """
    config, device = model.config, model.device
    peak_precision: Precision = "fp32" if model.precision == "int8" else model.precision
    limits = measure_limits(device, peak_precision)
    plain: Any = made_up_model(config) if model.is_exported else model.network
    fast = Version(model.prepared, device)
    first = config.past_frames
    timed, run = first + WARM_UP_FRAMES, first + WARM_UP_FRAMES + frames
    drive = MadeUpDrive(run + 2 * RUNS * max(frames, RUN_FRAMES))
    stages = _time_stages(fast, drive, first, range(timed, run))
    frame_s, peak = tuple(fast.seconds), peak_memory(device)
    run_frame_s, run_over_model = time_runs(fast, drive, run, max(frames, MIN_RUN_FRAMES))
    preprocessor = Preprocessor(config)
    prepared = preprocessor(drive.load(0))
    if profile_path is not None:
        with torch.profiler.profile() as profile:
            fast.step(prepared)
        profile.export_chrome_trace(str(profile_path))
    comparison = None
    if against_plain:
        inputs = (preprocessor(drive.load(place)) for place in range(frames))
        comparison, frame_s = compare_with_plain(plain, fast, inputs)
    size = (prepared.images.shape[-2], prepared.images.shape[-1])
    hits = plain.pillars(prepared.image_from_bev, size, prepared.has_image)
    return BenchmarkResult(
        model=config.name,
        device=device.type,
        precision=model.precision,
        engine=model.engine,
        machine=describe_machine(device),
        stages_s=stages,
        frame_s=frame_s,
        run_frame_s=run_frame_s,
        run_over_model=run_over_model,
        peak_memory_bytes=peak,
        operations=count_operations(config, hits.hits_per_camera),
        limits=limits.fastest(measure_limits(device, peak_precision)),
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

    write_behind(record, fast.runner.run(drive, places, preprocessor, fast.state))
    return [after - before for before, after in pairwise(made[:-1])]  # beside the last frame none is read


@contextlib.contextmanager
def _recording(drive: MadeUpDrive, fast: Version) -> Iterator[Recording]:
    """A recording with the default options in a temporary folder."""
    folder = tempfile.TemporaryDirectory(prefix="bevcli-bench-")
    with folder, Recording(Path(folder.name) / "recording.rrd", drive, Model(fast.runner.model)) as recording:
        yield recording


def measure_limits(device: torch.device, precision: Precision) -> MachineLimits:
    """The best of several matrix products in a precision, and of several copies, on a device."""
    edge = GPU_EDGE if device.type == "cuda" else CPU_EDGE
    matrix = torch.randn(edge, edge, device=device).to(DTYPES[precision])
    product = torch.empty_like(matrix)
    source, target = (torch.ones(COPIED_FLOATS, device=device) for _ in range(2))
    gemm_s = _best_seconds(lambda: torch.mm(matrix, matrix, out=product), device)
    copy_s = _best_seconds(lambda: target.copy_(source), device)
    return MachineLimits(2 * edge**3 / gemm_s / 1e9, 2 * 4 * COPIED_FLOATS / copy_s / 1e9)


def count_operations(config: ModelConfig, hits_per_camera: tuple[int, ...]) -> float:
    """Arithmetic operations of one frame with history; a multiplication and an addition are two.

    Counts matrix products, convolutions, attention and sampling of the plain model, from the shapes alone.
    hits_per_camera: number of BEV cells that each camera sees.
    """
    counter = FlopCounterMode(display=False, custom_mapping={torch.ops.aten.grid_sampler_2d: _sampling_operations})
    grid, cameras, total = config.bev_grid, len(hits_per_camera), sum(hits_per_camera)
    with torch.device("meta"), counter:
        model = build_network(config).eval().requires_grad_(False)
        width, height = config.image.padded_size
        hits = PillarHits(
            cell=torch.zeros(total, dtype=torch.int64),
            reference_points=torch.empty(total, grid.pillar_points, 2),
            hits_per_camera=hits_per_camera,
            cameras_per_cell=torch.ones(grid.rows * grid.columns, dtype=torch.int64),
        )
        model.run_on_shapes(torch.empty(1, cameras, 3, height, width), torch.zeros(cameras, dtype=torch.int64), hits)
    return float(counter.get_total_flops())


def _best_seconds(work: Callable[[], object], device: torch.device) -> float:
    work()
    best = float("inf")
    for _ in range(REPEATS):
        wait_for(device)
        began = time.perf_counter()
        work()
        wait_for(device)
        best = min(best, time.perf_counter() - began)
    return best


def _sampling_operations(*_shapes: Any, out_shape: Any, **_options: Any) -> int:
    return OPERATIONS_PER_SAMPLE * math.prod(out_shape)
