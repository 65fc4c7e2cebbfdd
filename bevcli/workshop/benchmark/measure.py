"""The benchmark: times every stage, and compares with the plain version and with the machine's peak throughput."""

import contextlib
import math
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from bevcli.config import load_config
from bevcli.frame import Frame, Prediction
from bevcli.inference.load import Model, choose_device
from bevcli.inference.pipeline import write_behind
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import RunnerState
from bevcli.model import Precision
from bevcli.model.config import ModelConfig
from bevcli.model.kernels.onednn import has_onednn
from bevcli.model.network import build_network
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.prepare import DTYPES, prepare_for_inference
from bevcli.printing import counted
from bevcli.recording.writer import Recording
from bevcli.workshop.benchmark.versions import (
    WARM_UP_FRAMES,
    Comparison,
    MadeUpDrive,
    Version,
    compare_with_plain,
    describe_machine,
    made_up_model,
    wait_for,
)
from bevcli.writing import whole_file

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

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


@dataclass(frozen=True)
class MachineLimits:
    """Peak throughput."""

    gemm_gflops: float  # rate of matrix products, 10^9 operations a second
    copy_gbs: float  # rate of copying memory, 10^9 bytes a second, read plus written

    def fastest(self, other: "MachineLimits") -> "MachineLimits":
        """The higher of two measurements; disturbances only make a measurement lower."""
        return MachineLimits(max(self.gemm_gflops, other.gemm_gflops), max(self.copy_gbs, other.copy_gbs))


@dataclass(frozen=True)
class BenchmarkResult:
    """All measurements of one model."""

    model: str  # its name
    device: str  # "cpu" or "cuda"
    precision: str  # of the prepared model or the exported file
    machine: str  # description of processor or GPU, threads and PyTorch's version
    stages_s: Mapping[str, tuple[float, ...]]  # stage -> seconds of each frame; no two stages ran at the same time
    frame_s: tuple[float, ...]  # seconds of the model's step for each frame, from network inputs to boxes
    run_frame_s: float  # median seconds of a frame in a whole run, where other threads decode, preprocess and record
    run_over_model: float  # the same, divided by the time of the model alone, which took turns with the runs
    peak_memory_bytes: int  # of the process on a CPU, of tensors on a GPU
    operations: float  # arithmetic operations of one frame
    limits: MachineLimits  # the machine's peak throughput
    comparison: Comparison | None = None  # with the plain version, None where that was not run
    engine: str = "torch"  # the program that ran the model

    @property
    def times_limit(self) -> float:
        """The frame's time divided by the time of its operations at the peak rate of matrix products."""
        return median(self.frame_s) / (self.operations / (self.limits.gemm_gflops * 1e9))

    @property
    def speedup(self) -> float | None:
        """The plain version's median frame time divided by the fast version's."""
        return median(self.comparison.plain_frame_s) / median(self.frame_s) if self.comparison else None

    def as_data(self) -> dict[str, object]:
        """The result for JSON."""
        frame_s = median(self.frame_s)
        data: dict[str, object] = {
            **{name: getattr(self, name) for name in ("model", "device", "precision", "engine", "machine")},
            "stages_ms": {stage: round(1000 * median(times), 3) for stage, times in self.stages_s.items()},
            "frame_ms": round(1000 * frame_s, 3),
            "frame_ms_spread": [round(1000 * min(self.frame_s), 3), round(1000 * max(self.frame_s), 3)],
            "run_frame_ms": round(1000 * self.run_frame_s, 3),
            "run_over_model": round(self.run_over_model, 3),
            "fps": round(1 / frame_s, 4),
            "peak_memory_mb": round(self.peak_memory_bytes / 1e6, 1),
            "operations_g": round(self.operations / 1e9, 2),
            "limits": {
                "gemm_gflops": round(self.limits.gemm_gflops, 1),
                "copy_gbs": round(self.limits.copy_gbs, 1),
                "times_limit": round(self.times_limit, 3),
            },
        }
        if self.comparison is not None and self.speedup is not None:
            data |= {
                "plain_frame_ms": round(1000 * median(self.comparison.plain_frame_s), 3),
                "speedup": round(self.speedup, 3),
                "max_box_difference_m": self.comparison.max_box_difference_m,
                "share_within_0.1_m": self.comparison.share_within_tenth_m,
                "max_score_difference": self.comparison.max_score_difference,
            }
        return data

    def text(self) -> str:
        """A table of the stages, then one line for each other measurement."""
        lines = [f"{self.model}, {self.precision}, {self.engine}, {self.machine}", ""]
        lines.append(f"{'stage':<22}{'median ms':>10}  fastest to slowest")
        for stage, times in {**self.stages_s, "whole frame": self.frame_s}.items():
            low, middle, high = (1000 * seconds for seconds in (min(times), median(times), max(times)))
            lines.append(f"{stage:<22}{middle:>10.1f}  {low:.1f} to {high:.1f}")
        frame_s, gemm = median(self.frame_s), self.limits.gemm_gflops
        run_ms, memory = 1000 * self.run_frame_s, self.peak_memory_bytes / 1e6
        lines += [
            "",
            f"model alone                {1 / frame_s:.3g} frames per second",
            f"with reading, recording    {run_ms:.0f} ms per frame, {self.run_over_model:.2f} times the model alone",
            f"operations                 {self.operations / 1e9:.0f} G per frame; "
            f"the frame takes {self.times_limit:.2f} times their time at the peak rate",
            f"peak rate                  {gemm:.0f} G operations per second (matrix products), "
            f"{self.limits.copy_gbs:.1f} GB/s (copying)",
            f"peak memory                {memory:.0f} MB",
        ]
        comparison = self.comparison
        if comparison is not None:
            lines += [
                f"plain version              {1000 * median(comparison.plain_frame_s):.0f} ms per frame, "
                f"{self.speedup:.2f} times the prepared model's",
                f"largest difference to it   {comparison.max_box_difference_m:.2g} m "
                f"({comparison.share_within_tenth_m:.1%} of the boxes within 0.1 m), "
                f"{comparison.max_score_difference:.2g} in the scores",
            ]
        return "\n".join(lines)


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
    fast = Version(model.prepared, device, takes_pixels=model.is_exported)
    first = config.past_frames
    timed, run = first + WARM_UP_FRAMES, first + WARM_UP_FRAMES + frames
    drive = MadeUpDrive(run + 2 * RUNS * max(frames, RUN_FRAMES))
    stages = _time_stages(fast, drive, first, range(timed, run))
    frame_s, peak = tuple(fast.seconds), peak_memory(device)
    run_frame_s, run_over_model = time_runs(fast, drive, run, max(frames, MIN_RUN_FRAMES))
    preprocessor = Preprocessor(config)
    prepared = preprocessor(drive.load(0))
    if profile_path is not None:
        with whole_file(profile_path) as unfinished:
            with torch.profiler.profile() as profile:
                fast.step(prepared)
            profile.export_chrome_trace(str(unfinished))
    comparison = None
    if against_plain:
        inputs = (preprocessor(drive.load(index)) for index in range(frames))
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
    times: dict[str, list[float]] = defaultdict(list)
    with _recording(drive, fast) as recording:
        for index in range(first, timed.stop):
            if index == first + 1:
                fast.fill_past(drive)
            if index == timed.start:
                times.clear()
                fast.seconds = []
            began = time.perf_counter()
            frame = drive.load(index)
            loaded = time.perf_counter()
            prepared = fast.runner.preprocess(frame)
            before = {"decode": loaded - began, "preprocess": time.perf_counter() - loaded}
            prediction = fast.step(prepared)
            recording_began = time.perf_counter()
            recording.log(frame, prediction)
            after = {"recording": time.perf_counter() - recording_began}
            for stage, seconds in {**before, **prediction.stage_seconds, **after}.items():
                times[stage].append(seconds)
    return {stage: tuple(seconds) for stage, seconds in times.items()}


def time_runs(
    fast: Version, drive: MadeUpDrive, index: int, frames: int, turns_s: float = TURNS_S
) -> tuple[float, float]:
    """Median seconds of a frame in whole runs, and how many times as long that is as a frame of the model alone.

    Both take turns, because the speed of a machine that others use changes within seconds. The frames of the drive are
    used once each, from `index` on; the model has seen those before.

    frames: of a run, at least. turns_s: of all turns if frames are short.
    """
    frame_s = median(fast.seconds)
    frames = max(frames, min(RUN_FRAMES, round(turns_s / RUNS / 2 / frame_s)))
    runs = max(1, min(RUNS, round(turns_s / (2 * frames * frame_s))))
    fast.seconds = []
    in_runs: list[float] = []
    with _recording(drive, fast) as recording:
        for first in range(index, index + 2 * frames * runs, 2 * frames):
            for alone in range(first, first + frames):
                fast.step(fast.runner.preprocess(drive.load(alone)))
            in_runs += _time_run(fast, drive, range(first + frames, first + 2 * frames), recording)
    return median(in_runs), median(in_runs) / median(fast.seconds)


def _time_run(fast: Version, drive: MadeUpDrive, indices: range, recording: Recording) -> list[float]:
    """Seconds of each frame while other threads read and record, as in `bevcli run`."""
    made: list[float] = []

    def record(step: tuple[Frame, Prediction, RunnerState[Any]]) -> None:
        made.append(time.perf_counter())  # recording begins as soon as the model has made the step, or late
        recording.log(*step[:2])
        fast.state = step[2]

    for _ in write_behind(fast.runner.run(drive, indices, fast.state), record):
        pass
    return [after - before for before, after in pairwise(made[:-1])]  # beside the last frame none is read


@contextlib.contextmanager
def _recording(drive: MadeUpDrive, fast: Version) -> Iterator[Recording]:
    """A recording with the default options in a temporary folder."""
    folder = tempfile.TemporaryDirectory(prefix="bevcli-bench-")
    with folder, Recording(Path(folder.name) / "recording.rrd", drive, Model(fast.runner.model)) as recording:
        yield recording


def measure_limits(device: torch.device, precision: Precision) -> MachineLimits:
    """The best of several matrix products in a precision, and of several copies, on a device.

    On a CPU without instructions for the precision: of products in float32, as those in its own take minutes.
    """
    edge, dtype = GPU_EDGE if device.type == "cuda" else CPU_EDGE, DTYPES[precision]
    if device.type == "cpu" and not has_onednn(dtype):
        dtype = torch.float32
    matrix = torch.randn(edge, edge, device=device).to(dtype)
    product = torch.empty_like(matrix)
    source, target = (torch.ones(COPIED_FLOATS, device=device) for _ in range(2))
    gemm_s = _best_seconds(lambda: torch.mm(matrix, matrix, out=product), device)
    copy_s = _best_seconds(lambda: target.copy_(source), device)
    return MachineLimits(2 * edge**3 / gemm_s / 1e9, 2 * 4 * COPIED_FLOATS / copy_s / 1e9)


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
        images, camera_index = torch.empty(1, cameras, 3, height, width), torch.zeros(cameras, dtype=torch.int64)
        model.run_shapes(images, camera_index, hits)
    return float(counter.get_total_flops())


def _sampling_operations(*_shapes: Any, out_shape: Any, **_options: Any) -> int:
    return OPERATIONS_PER_SAMPLE * math.prod(out_shape)


BUDGET_S = 40.0  # no further frame is begun after it
FRAMES = 20  # that are timed, at most
ROW_S = 8.0  # of the timed frames of a row
MODELS = ("demo", "tiny")
PRECISIONS: tuple[Precision, ...] = ("fp32", "bf16")


def measure_speed() -> dict[str, str]:
    """Median, fastest and slowest frame of each model and precision, and the machine's peak throughput."""
    began = time.perf_counter()
    device, drive = choose_device("auto"), MadeUpDrive(WARM_UP_FRAMES + FRAMES)
    limits = measure_limits(device, "fp32")
    rows = {"matrix products, copying": f"{limits.gemm_gflops:.0f} G operations/s in fp32, {limits.copy_gbs:.1f} GB/s"}
    for model in MODELS:
        network = made_up_model(load_config(model))
        for precision in PRECISIONS:
            if time.perf_counter() - began > BUDGET_S:
                rows[f"{model} {precision}"] = "not measured: the minute is over"
                continue
            version = Version(prepare_for_inference(network, device, precision), device)
            for index in range(len(drive.stamps)):
                version.step(version.runner.preprocess(drive.load(index)))
                timed = version.seconds[WARM_UP_FRAMES:]
                if timed and (sum(timed) > ROW_S or time.perf_counter() - began > BUDGET_S):
                    break
            timed = version.seconds[WARM_UP_FRAMES:]
            span = f"{1000 * min(timed):.0f} to {1000 * max(timed):.0f}"
            rows[f"{model} {precision}"] = (
                f"{1000 * median(timed):.0f} ms a frame ({span}, {counted(len(timed), 'frames')})"
            )
    load = "not known on this system"
    if hasattr(os, "getloadavg"):
        load = f"{os.getloadavg()[0]:.1f} processes wanted a core in the last minute, this one included"
    return rows | {"load": load}


def peak_memory(device: torch.device) -> int:
    """Peak memory in bytes: of the whole process on a CPU, of tensors on a GPU. 0 on Windows, which does not tell."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if resource is None:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
