"""The result of a benchmark, as JSON and as text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median

from bevcli.benchmark.limits import MachineLimits


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
        """The object that --json prints."""
        frame_s = median(self.frame_s)
        data: dict[str, object] = {
            "model": self.model,
            "device": self.device,
            "precision": self.precision,
            "engine": self.engine,
            "machine": self.machine,
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
        return "\n".join(lines + self._comparison_lines())

    def _comparison_lines(self) -> list[str]:
        if self.comparison is None:
            return []
        found = self.comparison
        return [
            f"plain version              {1000 * median(found.plain_frame_s):.0f} ms per frame, "
            f"{self.speedup:.2f} times the prepared model's",
            f"largest difference to it   {found.max_box_difference_m:.2g} m "
            f"({found.share_within_tenth_m:.1%} of the boxes within 0.1 m), "
            f"{found.max_score_difference:.2g} in the scores",
        ]
