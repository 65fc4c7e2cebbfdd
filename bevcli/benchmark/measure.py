"""The benchmark: times every stage, and compares with the plain version and with the machine's peak throughput."""

from __future__ import annotations

import contextlib
import platform
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

import torch

from bevcli.benchmark.comparison import compare_with_plain
from bevcli.benchmark.limits import count_operations, measure_limits
from bevcli.benchmark.made_up import MadeUpDrive, made_up_model
from bevcli.benchmark.result import BenchmarkResult
from bevcli.benchmark.version import Version
from bevcli.frame import Frame, Prediction
from bevcli.model.bevformer import BEVFormerBase, BEVFormerConfig
from bevcli.model.bevformer_v2 import BEVFormerV2Config
from bevcli.model.prepared import Precision, prepare_for_inference
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.preprocess import PreparedFrame, Preprocessor
from bevcli.pipeline.runner import BevState
from bevcli.pipeline.write_behind import write_behind
from bevcli.recording.writer import Recording

WARM_UP_FRAMES = 2  # one without and one with history
MIN_RUN_FRAMES = 4  # of a run with reading and recording; the times between them are measured, but for the last
RUN_FRAMES = 12  # of a run if frames are short
RUNS = 6  # that take turns with the model alone if frames are short
TURNS_S = 30.0  # for all turns if frames are short; with slow models one run


@dataclass(frozen=True)
class BenchmarkSettings:
    """What is measured.

    Attributes:
        config: the model.
        device: where it runs.
        precision: of the prepared model.
        frames: number of timed frames, after the warm-up.
        against_plain: whether the plain version is timed too, and the results compared.
        profile: where to write PyTorch's profile of one frame (Chrome's trace format), None for no profile.
        exported: an exported file of the model, which is timed with its own weights and precision; None for PyTorch.
    """

    config: BEVFormerConfig
    device: torch.device
    precision: Precision
    frames: int = 5
    against_plain: bool = False
    profile: Path | None = None
    exported: Model | None = None


def run_benchmark(settings: BenchmarkSettings) -> BenchmarkResult:
    """Runs all measurements one after another. Nothing else should run on the machine."""
    config, device = settings.config, settings.device
    limits = measure_limits(device, settings.precision)
    model = made_up_model(config)
    exported = settings.exported
    network = prepare_for_inference(model, device, settings.precision) if exported is None else exported.prepared
    fast = Version(network, device)
    first = config.past_frames if isinstance(config, BEVFormerV2Config) else 0
    timed, run = first + WARM_UP_FRAMES, first + WARM_UP_FRAMES + settings.frames
    drive = MadeUpDrive(run + 2 * RUNS * max(settings.frames, RUN_FRAMES))
    stages = _time_stages(fast, drive, first, range(timed, run))
    frame_s, peak = tuple(fast.seconds), _peak_memory(device)
    run_frame_s, run_over_model = _time_runs(fast, drive, run, max(settings.frames, MIN_RUN_FRAMES))
    if settings.profile is not None:
        _write_profile(fast, _prepared(drive, config, 0), settings.profile)
    comparison = None
    if settings.against_plain:
        frames = (_prepared(drive, config, place) for place in range(settings.frames))
        comparison, frame_s = compare_with_plain(model, fast, frames)
    return BenchmarkResult(
        model=config.name,
        device=device.type,
        precision=settings.precision if exported is None else exported.precision,
        engine="torch" if exported is None else exported.engine,
        machine=describe_machine(device),
        stages_s=stages,
        frame_s=frame_s,
        run_frame_s=run_frame_s,
        run_over_model=run_over_model,
        peak_memory_bytes=peak,
        operations=count_operations(config, _hits(model, _prepared(drive, config, 0))),
        limits=limits.fastest(measure_limits(device, settings.precision)),
        comparison=comparison,
    )


def describe_machine(device: torch.device) -> str:
    """Name of the processor or GPU, number of threads and PyTorch's version."""
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, PyTorch {torch.__version__}"
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    capability = torch.backends.cpu.get_cpu_capability()
    return f"{name} ({capability}), {torch.get_num_threads()} threads, PyTorch {torch.__version__}"


def _time_stages(fast: Version, drive: MadeUpDrive, first: int, timed: range) -> dict[str, tuple[float, ...]]:
    """Seconds of each stage of the timed frames, after a warm-up; no two stages run at the same time.

    first: the frame that the warm-up begins with. After it the model has all the history that it uses.
    """
    preprocessor = Preprocessor(fast.runner.config)
    times: dict[str, list[float]] = defaultdict(list)
    with _recording(drive, fast) as recording:
        for place in range(first, timed.stop):
            if place == first + 1:
                fast.fill_window(drive)
            if place == timed.start:
                times.clear()
                fast.forget_times()
            marks = [time.perf_counter()]
            frame = drive.load(place)
            marks.append(time.perf_counter())
            prepared = preprocessor(frame)
            marks.append(time.perf_counter())
            prediction = fast.step(prepared)
            recording_began = time.perf_counter()
            recording.log(frame, prediction)
            recording_s = time.perf_counter() - recording_began
            outside = {"decode": marks[1] - marks[0], "preprocess": marks[2] - marks[1]}
            for stage, seconds in {**outside, **prediction.stage_seconds, "recording": recording_s}.items():
                times[stage].append(seconds)
    return {stage: tuple(seconds) for stage, seconds in times.items()}


def _time_runs(fast: Version, drive: MadeUpDrive, place: int, frames: int) -> tuple[float, float]:
    """Median seconds of a frame in whole runs, and how many times as long that is as a frame of the model alone.

    Both take turns, because the speed of a machine that others use changes within seconds.

    Args:
        fast: the model; it has seen the frames before `place`, and afterwards all that are used.
        drive: its frames from `place` on are used, each once.
        place: index of the first frame.
        frames: of a run, at least.
    """
    frame_s = median(fast.seconds)
    frames = max(frames, min(RUN_FRAMES, round(TURNS_S / RUNS / 2 / frame_s)))
    runs = max(1, min(RUNS, round(TURNS_S / (2 * frames * frame_s))))
    preprocessor = Preprocessor(fast.runner.config)
    fast.forget_times()
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

    def record(step: tuple[Frame, Prediction, BevState | None]) -> None:
        made.append(time.perf_counter())  # recording begins as soon as the model has made the step
        recording.log(*step[:2])

    for step, _ in write_behind(record, fast.runner.run(drive, places, preprocessor, fast.state)):
        fast.state = step[2]
    return [after - before for before, after in pairwise(made[:-1])]  # beside the last frame none is read


@contextlib.contextmanager
def _recording(drive: MadeUpDrive, fast: Version) -> Iterator[Recording]:
    """A recording with the default options in a temporary folder."""
    untrained = Model(fast.runner.model)
    with (
        tempfile.TemporaryDirectory(prefix="bevcli-bench-") as folder,
        Recording(Path(folder) / "recording.rrd", drive, untrained) as recording,
    ):
        yield recording


def _write_profile(fast: Version, prepared: PreparedFrame, path: Path) -> None:
    with torch.profiler.profile() as profile:
        fast.step(prepared)
    profile.export_chrome_trace(str(path))


def _prepared(drive: MadeUpDrive, config: BEVFormerConfig, place: int) -> PreparedFrame:
    return Preprocessor(config)(drive.load(place))


def _hits(model: BEVFormerBase, prepared: PreparedFrame) -> tuple[int, ...]:
    size = (prepared.images.shape[-2], prepared.images.shape[-1])
    return model.pillars(prepared.image_from_bev, size, prepared.has_image).hits_per_camera


def _peak_memory(device: torch.device) -> int:
    """Peak memory in bytes: of the whole process on a CPU, of tensors on a GPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
