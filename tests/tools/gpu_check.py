"""`make gpu-check`: everything that only a GPU can tell, as a report in Markdown to paste into an issue.

    python tests/tools/gpu_check.py [--device cuda] [--out gpu-report.md] [--model NAME]...

Results are printed, and added to the report, as soon as they are known: first the speed of every model and its boxes
compared with those of the plain model, then a training, then the tests marked `gpu`. Each part is a process of its own,
so that one that fails or hangs does not end the others. While one process measures, the next ones prepare their models.
The whole check ends after 8 minutes, the last two and a half of which are for training and tests; parts that are not
done in their time count as failed.
"""

import argparse
import contextlib
import fcntl
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, get_args

import torch

from bevcli._version import __version__
from bevcli.config import known_models, load_config
from bevcli.errors import BevcliError
from bevcli.inference.load import choose_device
from bevcli.inference.pipeline import image_uploader
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner
from bevcli.model import Precision
from bevcli.model.network import Network
from bevcli.model.prepare import methods_on_device, prepare_for_inference
from bevcli.model.step import PreparedFrame
from bevcli.model.temporal_model import TemporalModel
from bevcli.printing import say
from bevcli.workshop.benchmark.measure import time_runs
from bevcli.workshop.benchmark.versions import (
    MadeUpDrive,
    QueryResults,
    Version,
    describe_machine,
    difference,
    largest_differences,
    made_up_model,
    textbook_version,
)
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.training import TrainOptions
from bevcli.workshop.training.job import prepare_training
from bevcli.workshop.training.trainer import Trainer
from bevcli.writing import write_whole

ROOT = Path(__file__).parents[2]  # of the repository
BUDGET_S = 480.0  # of the whole check
FOR_MODELS = 0.7  # share of it
TOGETHER = 3  # processes at a time, of which one uses the device
FIRST = ("tiny", "demo", "base", "small", "v2-t1", "vad-tiny", "uniad-track-map")  # the order of the models
PRECISIONS: tuple[Precision, ...] = ("fp16", "bf16", "fp32")
assert set(PRECISIONS) == set(get_args(Precision))
COMPARED_FRAMES = 3  # all but the first have history; a CUDA graph computes the last
COMPARED_ON_CPU = ("tiny", "demo")  # the plain version of the others takes too long there
TIMED_STEPS, PROFILED_STEPS = 12, 4
RUN_FRAMES, RUNS_S = 8, 6.0  # of the whole runs
TRAINED_MODEL, TRAINED_S, TRAINED_ON = "demo", 40.0, "samples/street"
TRAINED_CLIPS, TRAINED_BYTES = 24, 20e9  # of a batch, on a GPU with so much memory
# What the prepared and the plain model may differ by at most.
MIN_SHARE_WITHIN_TENTH_M, MAX_SCORE_DIFFERENCE = 0.99, 0.02
SHOWN_LINES = 15  # of what a failed process printed
COLUMNS = {
    "model": "",
    "precision": "",
    "wall, ms": ".2f",
    "without graph, ms": ".2f",
    "kernels, ms": ".2f",
    "kernels": ".0f",
    "launches": ".0f",
    "run / model": ".2f",
    "boxes within 0.1 m": ".2%",
    "largest difference, m": ".3g",
    "largest score difference": ".2g",
    "error": "",
}


class CheckFailed(Exception):
    """A part of the check found something wrong, or could not run; the message is Markdown."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the check. Returns the exit code: 0 if everything passed, else 1."""
    parser = argparse.ArgumentParser(prog="make gpu-check", description="Check bevcli on a GPU and write a report.")
    parser.add_argument("--device", default="auto", help='auto, cuda, cuda:N or mps; "cpu" tries the check itself')
    parser.add_argument("--out", type=Path, default=Path("gpu-report.md"), help="the report")
    parser.add_argument("--model", action="append", help="only this model (repeatable); default: all known models")
    # One part, in a process of its own.
    parser.add_argument("--measure", metavar="MODEL", help=argparse.SUPPRESS)
    parser.add_argument("--turn", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--train", metavar="MODEL", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    try:
        device = gpu_of(asked.device)
        if asked.measure is not None:
            for row in measure_model(asked.measure, device, asked.turn):
                print(json.dumps(row), flush=True)
            return 0
        if asked.train is not None:
            print(json.dumps(train(asked.train, device, asked.seconds)), flush=True)
            return 0
        models = asked.model or sorted(known_models(), key=lambda name: (*FIRST, name).index(name))
        failed = Check(device, asked.out).run(models)
    except BevcliError as error:
        say(f"error: {error}", err=True)
        return 1
    say(f"wrote {asked.out}: {'failed: ' + ', '.join(failed) if failed else 'everything passed'}")
    return 1 if failed else 0


def gpu_of(name: str) -> torch.device:
    """The device to check; "auto" takes a CUDA GPU, else the GPU of a Mac. Raises BevcliError if there is neither."""
    if name == "auto" and not torch.cuda.is_available():
        if not torch.backends.mps.is_available():
            raise BevcliError(f"gpu-check: PyTorch {torch.__version__} sees no GPU here, so there is nothing to check")
        name = "mps"
    return choose_device(name)


class Check:
    """All parts of the check, and the report, which is written anew after every result.

    Attributes:
        lines: of the report.
        failed: the parts that failed.
    """

    def __init__(self, device: torch.device, out: Path) -> None:
        self.device, self._out, self._began, self._budget_s = device, out, time.monotonic(), BUDGET_S
        self._lock = threading.Lock()
        self.lines: list[str] = []
        self.failed: list[str] = []

    def run(self, models: Sequence[str]) -> list[str]:
        """Run all parts. Returns those that failed."""
        cuda = torch.version.cuda or "none"
        machine = f"{describe_machine(self.device)}, CUDA {cuda}, Python {sys.version.split()[0]}."
        rule = " | ".join("---" for _ in COLUMNS)
        self.report(f"# bevcli {__version__} on {self.device}", "")
        self.report(f"{date.today().isoformat()}: {machine}", "", f"| {' | '.join(COLUMNS)} |", f"| {rule} |")
        with tempfile.TemporaryDirectory(prefix="bevcli-gpu-check-") as folder, ThreadPoolExecutor(TOGETHER) as pool:
            turn = Path(folder) / "turn"
            turn.touch()
            self._budget_s = BUDGET_S * FOR_MODELS
            list(pool.map(lambda model: self.measure(model, turn), models))
            self._budget_s = BUDGET_S
        self.report("")
        self.part("training", self.train)
        self.part("tests", self.run_tests)
        return self.failed

    def report(self, *lines: str) -> None:
        """Prints lines and adds them to the report."""
        with self._lock:
            for line in lines:
                say(line)
            self.lines += lines
            write_whole(self._out, ("\n".join(self.lines) + "\n").encode())

    def part(self, title: str, run: Any) -> None:
        """Reports a part that returns its text."""
        try:
            text, verdict = run(), "passed"
        except CheckFailed as failure:
            text, verdict = str(failure), "FAILED"
            self.failed.append(title)
        self.report(f"## {title}: {verdict}", "", text, "")

    def measure(self, model: str, turn: Path) -> None:
        """Reports the rows of a model."""
        rows = 0
        try:
            for line in self.process(own_part("--measure", model, "--turn", str(turn), device=self.device), model):
                if line.startswith("{"):
                    row = json.loads(line)
                    rows += 1
                    self.report(table_row(row))
                    if "error" in row:
                        self.failed.append(f"{model} {row['precision']}")
        except CheckFailed as failure:
            self.failed.append(model)
            self.report(table_row({"model": model, "error": str(failure)}))

    def train(self) -> str:
        """A short training. Raises CheckFailed unless every loss is finite."""
        command = own_part("--train", TRAINED_MODEL, "--seconds", str(TRAINED_S), device=self.device)
        found = json.loads(list(self.process(command, "the training"))[-1])
        text = (
            f"{TRAINED_MODEL}: {found['updates']} updates of {found['clips']} clips, "
            f"{found['updates a second']:.2f} a second after the first, {found['frames a second']:.0f} frames learned "
            f"a second; first update after {found['first_s']:.1f} s; {found['without data']:.1%} of the time without "
            f"data; last loss {found['loss']:.3g}."
        )
        if not found["finite"]:
            raise CheckFailed(text)
        return text

    def run_tests(self) -> str:
        """The tests marked `gpu`. Raises CheckFailed."""
        command = [sys.executable, "-m", "pytest", "-m", "gpu", "-q", "--durations=0"]
        return f"`{list(self.process(command, 'the tests'))[-1]}`"

    def process(self, command: list[str], what: str) -> Iterator[str]:
        """The lines that a process prints, as it prints them. Raises CheckFailed if it fails or takes too long."""
        ends = self._began + self._budget_s
        left = ends - time.monotonic()
        if left <= 0:
            raise CheckFailed(f"{what}: not run, because its part of the {BUDGET_S:g} s of the check is over")
        with tempfile.TemporaryFile("w+") as errors:
            process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True)
            timer = threading.Timer(left, process.kill)
            timer.start()
            printed: list[str] = []
            assert process.stdout is not None
            try:
                for line in process.stdout:
                    printed.append(line.rstrip())
                    yield line.rstrip()
            finally:
                timer.cancel()
                process.stdout.close()
                code = process.wait()
            if time.monotonic() >= ends:
                raise CheckFailed(f"{what}: not done when its part of the {BUDGET_S:g} s of the check was over")
            if code:
                errors.seek(0)
                last = "\n".join([*printed, *errors.read().strip().splitlines()][-SHOWN_LINES:])
                raise CheckFailed(f"{what}: exit code {code}\n\n```\n{last}\n```")


def own_part(*arguments: str, device: torch.device) -> list[str]:
    """The command of a part that this file runs."""
    return [sys.executable, __file__, *arguments, "--device", str(device)]


def table_row(row: dict[str, Any]) -> str:
    """A row of the table in Markdown."""
    cells = [format(row[name], kind) if name in row else "" for name, kind in COLUMNS.items()]
    return f"| {' | '.join(' '.join(cell.split())[-300:].replace('|', '/') for cell in cells)} |"


@contextlib.contextmanager
def taking_turns(turn: Path | None) -> Iterator[None]:
    """Inside, no other process of the check uses the device."""
    with contextlib.nullcontext() if turn is None else turn.open() as file:
        if file is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def measure_model(name: str, device: torch.device, turn: Path | None = None) -> Iterator[dict[str, Any]]:
    """One row per precision; the names are those of `COLUMNS`. "error": what failed, or that the boxes differ too much.

    The prepared model is compared with the plain one on the device, in float32 without TF32; a small model also with
    the plain one on the CPU, in a row of its own.
    """
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // TOGETHER))
    config = load_config(name)
    model, preprocess = made_up_model(config), Preprocessor(config)
    drive = MadeUpDrive(config.past_frames + TIMED_STEPS + 200)
    frames = [preprocess(drive.load(place)) for place in range(COMPARED_FRAMES)]
    later = [preprocess(drive.load(config.past_frames + place)) for place in range(TIMED_STEPS)]
    on_cpu = plain_results(model, torch.device("cpu"), frames) if name in COMPARED_ON_CPU else None
    with taking_turns(turn):
        timed = list(map(image_uploader(device), later)) if device.type == "cuda" else later
        plain = plain_results(model, device, frames)
        if on_cpu is not None:
            yield {"model": name, "precision": "plain, CPU"} | differences(plain, on_cpu)
        for precision in PRECISIONS:
            row: dict[str, Any] = {"model": name, "precision": precision}
            try:
                row |= measure_precision(model, device, precision, drive, frames, timed, plain)
                if precision == PRECISIONS[0]:
                    row |= measure_whole_run(model, device, precision, drive, timed)
            except Exception as error:  # whatever a GPU raises is what the report is for
                row["error"] = f"{type(error).__name__}: {error}"
            yield row


def plain_results(model: Network, device: torch.device, frames: Sequence[PreparedFrame]) -> list[QueryResults]:
    """The boxes of each frame by the plain model, in float32 without TF32."""
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        return results(Version(textbook_version(model, device), device), frames)


def results(version: Version, frames: Sequence[PreparedFrame]) -> list[QueryResults]:
    """The boxes of each frame."""
    found = []
    for frame in frames:
        version.step(frame)
        centers, scores = version.queries
        found.append((centers.float().cpu(), scores.float().cpu()))
    return found


class BareVersion(Version):
    """A version without what costs launches: the times of stages, and the results of queries."""

    def __init__(self, model: TemporalModel, device: torch.device, drive: MadeUpDrive) -> None:
        super().__init__(model, device)
        self.runner = Runner(model, device)
        self.drive = drive

    def _keep(self, *_: object) -> None:
        pass

    def median_ms(self, frames: Sequence[PreparedFrame]) -> float:
        """The median time of a step, after two untimed ones. The frames follow each other."""
        self.seconds = []
        for place, frame in enumerate(frames):
            self.step(frame)
            if place == 0:
                self.fill_past(self.drive)
        return 1000 * median(self.seconds[2:])


def measure_precision(
    model: Network,
    device: torch.device,
    precision: Precision,
    drive: MadeUpDrive,
    frames: Sequence[PreparedFrame],
    timed: Sequence[PreparedFrame],
    plain: Sequence[QueryResults],
) -> dict[str, Any]:
    """The cells of a row: the boxes, then the times of a step, which need no history of their own."""
    network = prepare_for_inference(model, device, precision)
    row = differences(results(Version(network, device), frames), plain)
    version = BareVersion(network, device, drive)
    version.median_ms(timed)  # warms up, and captures CUDA graphs
    row["wall, ms"] = version.median_ms(timed)
    if precision == PRECISIONS[0] and device.type == "cuda":
        row |= profile(version, timed[-PROFILED_STEPS:])
        with without_graphs(network) as has_graphs:
            if has_graphs:
                row["without graph, ms"] = version.median_ms(timed)
    return row


def differences(found: Sequence[QueryResults], expected: Sequence[QueryResults]) -> dict[str, Any]:
    """The cells of a row that compare the boxes of frames."""
    pairs = [difference(one, other) for one, other in zip(found, expected, strict=True)]
    distance_m, share, score = largest_differences(pairs)
    row: dict[str, Any] = {"boxes within 0.1 m": share, "largest difference, m": distance_m}
    row["largest score difference"] = score
    if not (share >= MIN_SHARE_WITHIN_TENTH_M and score <= MAX_SCORE_DIFFERENCE):
        row["error"] = "differs too much"
    return row


def profile(version: Version, frames: Sequence[PreparedFrame]) -> dict[str, float]:
    """Sum and number of the kernels and copies of a step, and how many launches by the CPU they took."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as found:
        for frame in frames:
            version.step(frame)
    events = found.events() or []
    on_device = [event for event in events if event.device_type == torch.autograd.DeviceType.CUDA]
    launches = [event for event in events if event.name.startswith("cu") and is_launch(event.name)]
    return {
        "kernels, ms": sum(event.time_range.elapsed_us() for event in on_device) / 1000 / len(frames),
        "kernels": len(on_device) / len(frames),
        "launches": len(launches) / len(frames),
    }


def is_launch(name: str) -> bool:
    """Whether a function of CUDA gives the device work."""
    return any(word in name for word in ("Launch", "Memcpy", "Memset"))


@contextlib.contextmanager
def without_graphs(network: TemporalModel) -> Iterator[bool]:
    """Inside, nothing is replayed as a CUDA graph. Yields whether anything was before."""
    parts = [getattr(network, name) for name in methods_on_device(type(network))]
    captured = [part for part in parts if any(getattr(part, "graphs", {}).values())]
    for part in captured:
        part.failure = RuntimeError("switched off")
    yield bool(captured)
    for part in captured:
        part.failure = None


def measure_whole_run(
    model: Network, device: torch.device, precision: Precision, drive: MadeUpDrive, timed: Sequence[PreparedFrame]
) -> dict[str, float]:
    """How many times as long a frame takes in a run that reads and records as by the model alone."""
    version = BareVersion(prepare_for_inference(model, device, precision), device, drive)
    version.median_ms(timed)
    first = model.config.past_frames + len(timed)
    return {"run / model": time_runs(version, drive, first, RUN_FRAMES, RUNS_S)[1]}


def train(model: str, device: torch.device, seconds: float) -> dict[str, Any]:
    """Speed of the updates of so many seconds, at least one, on the sample drive."""
    losses: list[float] = []
    ends: list[float] = []
    with tempfile.TemporaryDirectory(prefix="bevcli-gpu-check-") as folder:
        large = device.type == "cuda" and torch.cuda.get_device_properties(device).total_memory >= TRAINED_BYTES
        changes = {"clips.batch": str(TRAINED_CLIPS)} if large else {}
        options = TrainOptions(out=Path(folder) / "train", held_out=0, changes=changes)
        trainer = Trainer(prepare_training(model, device, DriveOptions(data=(ROOT / TRAINED_ON,)), options))
        began = time.perf_counter()
        for progress in trainer.run():
            if progress.loss is not None:
                losses.append(progress.loss)
                ends.append(time.perf_counter())
                if ends[-1] - began > seconds:
                    break
    a_second = 1 / (sum(later - end for end, later in pairwise(ends)) / max(len(ends) - 1, 1) or math.inf)
    return {
        "updates": len(losses),
        "updates a second": a_second,
        "clips": trainer.job.config.clips.batch,
        "frames a second": a_second * trainer.job.config.clips.batch,
        "first_s": ends[0] - began,
        "without data": getattr(trainer, "waited_s", math.nan) / (ends[-1] - began),
        "loss": losses[-1],
        "finite": all(map(math.isfinite, losses)),
    }


if __name__ == "__main__":
    sys.exit(main())
