"""The result of a benchmark, as JSON, as text, and in the table of docs/speed.md."""

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import date
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import torch

from bevcli.config import known_models
from bevcli.errors import BevcliError
from bevcli.model.kernels.onednn import has_onednn
from bevcli.parsing.files import MIB, read_text
from bevcli.printing import say
from bevcli.writing import write_whole

MODEL_TIMEOUT_S = 4 * 3600.0
LARGEST_DOCUMENT = 16 * MIB
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"
COLUMNS: Mapping[str, Callable[[dict[str, Any]], str]] = {
    "model": lambda r: r["model"],
    "precision": lambda r: r["precision"],
    "frame, ms": lambda r: f"{r['frame_ms']:.0f}",
    "frames a second": lambda r: f"{r['fps']:.3g}",
    "plain, ms": lambda r: f"{r['plain_frame_ms']:.0f}",
    "times faster": lambda r: f"{r['speedup']:.2f}",
    "times the limit": lambda r: f"{r['limits']['times_limit']:.2f}",
    "G operations": lambda r: f"{r['operations_g']:.0f}",
    "matrix products, G/s": lambda r: f"{r['limits']['gemm_gflops']:.0f}",
    "run / model": lambda r: f"{r['run_over_model']:.2f}",
    "memory, MB": lambda r: f"{r['peak_memory_mb']:.0f}",
    "boxes within 0.1 m": lambda r: f"{r['share_within_0.1_m']:.1%}",
    "largest score difference": lambda r: f"{r['max_score_difference']:.1g}",
}


@dataclass(frozen=True)
class MachineLimits:
    """Peak throughput.

    Attributes:
        gemm_gflops: rate of matrix products, 10^9 operations a second.
        copy_gbs: rate of copying memory, 10^9 bytes a second, read plus written.
    """

    gemm_gflops: float
    copy_gbs: float

    def fastest(self, other: "MachineLimits") -> "MachineLimits":
        """The higher of two measurements; disturbances only make a measurement lower."""
        return MachineLimits(max(self.gemm_gflops, other.gemm_gflops), max(self.copy_gbs, other.copy_gbs))


@dataclass(frozen=True)
class Comparison:
    """The fast version compared with the plain one, over all object queries of all frames.

    Attributes:
        plain_frame_s: seconds of each frame of the plain version.
        max_box_difference_m: largest distance between the two versions' box centres.
        share_within_tenth_m: share of the box centres that are within 0.1 m of each other.
        max_score_difference: largest difference of scores.
    """

    plain_frame_s: tuple[float, ...]
    max_box_difference_m: float
    share_within_tenth_m: float
    max_score_difference: float


@dataclass(frozen=True)
class BenchmarkResult:
    """All measurements of one model.

    Attributes:
        model: its name.
        device: "cpu" or "cuda".
        precision: of the prepared model or the exported file.
        machine: description of processor or GPU, threads and PyTorch's version.
        stages_s: stage -> seconds of each frame; no two stages ran at the same time.
        frame_s: seconds of the model's step for each frame, from network inputs to boxes.
        run_frame_s: median seconds of a frame in a whole run, where other threads decode, preprocess and record.
        run_over_model: the same, divided by the time of the model alone, which took turns with the runs.
        peak_memory_bytes: of the process on a CPU, of tensors on a GPU.
        operations: arithmetic operations of one frame.
        limits: the machine's peak throughput.
        comparison: with the plain version, None where that was not run.
        engine: the program that ran the model.
    """

    model: str
    device: str
    precision: str
    machine: str
    stages_s: Mapping[str, tuple[float, ...]]
    frame_s: tuple[float, ...]
    run_frame_s: float
    run_over_model: float
    peak_memory_bytes: int
    operations: float
    limits: MachineLimits
    comparison: Comparison | None = None
    engine: str = "torch"

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
        found = self.comparison
        if found is not None:
            lines += [
                f"plain version              {1000 * median(found.plain_frame_s):.0f} ms per frame, "
                f"{self.speedup:.2f} times the prepared model's",
                f"largest difference to it   {found.max_box_difference_m:.2g} m "
                f"({found.share_within_tenth_m:.1%} of the boxes within 0.1 m), "
                f"{found.max_score_difference:.2g} in the scores",
            ]
        return "\n".join(lines)


def write_table(path: Path, device: torch.device, frames: int) -> None:
    """Measures every model in every precision, and writes the table between the lines BEGIN and END of a document.

    The table is written after each measurement. One that fails is said and left out. On a CPU without bfloat16
    instructions only float32 is measured.

    Raises BevcliError where an existing file lacks these lines, and at the end where a measurement failed.
    """
    text = read_text(path, LARGEST_DOCUMENT) if path.is_file() else f"{BEGIN}\n{END}\n"
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise BevcliError(f"{path}: cannot find where to write the table (expected the lines {BEGIN} and {END})")
    on_cpu = ("fp32", "bf16") if has_onednn(torch.bfloat16) else ("fp32",)
    results, failures = [], 0
    for model, precision in product(known_models(), ("bf16", "fp16") if device.type == "cuda" else on_cpu):
        try:
            results.append(measure(model, precision, device, frames))
        except BevcliError as error:
            say(str(error), err=True)
            failures += 1
        else:
            write_whole(path, f"{before}{begin}\n{markdown_table(results)}\n{end}{after}".encode())
    if failures:
        raise BevcliError(f"{path}: {failures} of {failures + len(results)} measurements failed and are left out")


def measure(
    model: str, precision: str, device: torch.device, frames: int, limit_s: float = MODEL_TIMEOUT_S
) -> dict[str, Any]:
    """Results of `bevcli bench --against plain --json` in a process of its own, whose peak memory is that model's.

    Raises BevcliError if it fails or takes longer than limit_s.
    """
    say(f"measuring {model}, {precision} …", err=True)
    options = ["--model", model, "--precision", precision, "--device", str(device), "--count", str(frames)]
    command = [sys.executable, "-m", "bevcli", "bench", *options, "--against", "plain", "--json"]
    try:
        answer = subprocess.run(command, check=True, capture_output=True, text=True, timeout=limit_s)
    except subprocess.TimeoutExpired:
        raise BevcliError(f"bench: {model}, {precision}: not done within {limit_s / 3600:g} h") from None
    except subprocess.CalledProcessError as error:
        last = (error.stderr.strip().splitlines() or ["no message"])[-1]
        raise BevcliError(f"bench: {model}, {precision}: failed with exit code {error.returncode} ({last})") from None
    found: dict[str, Any] = json.loads(answer.stdout)
    return found


def markdown_table(results: list[dict[str, Any]]) -> str:
    """The machine and a table of results in Markdown, one row a result of `measure`."""
    machine = f"Measured on {date.today().isoformat()}: {results[0]['machine']}."
    rows = [" | ".join(column(result) for column in COLUMNS.values()) for result in results]
    lines = [" | ".join(COLUMNS), " | ".join("---" for _ in COLUMNS), *rows]
    return "\n".join([machine, "", *(f"| {line} |" for line in lines)])
