"""What a benchmark found out: one frozen value, as JSON and as lines to read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median

from bevcli.benchmark.limits import MachineLimits


@dataclass(frozen=True)
class Comparison:
    """The fast version beside the plain one, on the same frames.

    plain_frame_s: of each frame. Over all object queries of all frames: how far apart the centres of the boxes are
    (m), the share of them that are within 0.1 m, and how far apart the scores are.
    """

    plain_frame_s: tuple[float, ...]
    max_box_difference_m: float
    share_within_tenth_m: float
    max_score_difference: float


@dataclass(frozen=True)
class BenchmarkResult:
    """machine: in words. stages_s: stage -> seconds of each frame, each stage alone on the machine.

    frame_s: the model's step of each frame, from network input to boxes. run_frame_s: seconds a frame of a whole run,
    where decoding, preprocessing and recording go on beside the model. operations: of one frame.
    """

    model: str
    device: str
    precision: str
    machine: str
    stages_s: Mapping[str, tuple[float, ...]]
    frame_s: tuple[float, ...]
    run_frame_s: float
    peak_memory_bytes: int
    operations: float
    limits: MachineLimits
    comparison: Comparison | None = None

    @property
    def times_limit(self) -> float:
        """The frame's time over that of its operations at the rate of matrix products."""
        return median(self.frame_s) / (self.operations / (self.limits.gemm_gflops * 1e9))

    @property
    def speedup(self) -> float | None:
        """The plain version's median frame time over the fast one's."""
        return median(self.comparison.plain_frame_s) / median(self.frame_s) if self.comparison else None

    def as_data(self) -> dict[str, object]:
        """What --json prints."""
        frame_s = median(self.frame_s)
        data: dict[str, object] = {
            "model": self.model,
            "device": self.device,
            "precision": self.precision,
            "machine": self.machine,
            "stages_ms": {stage: round(1000 * median(times), 3) for stage, times in self.stages_s.items()},
            "frame_ms": round(1000 * frame_s, 3),
            "frame_ms_spread": [round(1000 * min(self.frame_s), 3), round(1000 * max(self.frame_s), 3)],
            "run_frame_ms": round(1000 * self.run_frame_s, 3),
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
        """The same for a person, stage by stage."""
        lines = [f"{self.model}, {self.precision}, {self.machine}", ""]
        lines.append(f"{'stage':<22}{'median ms':>10}  fastest to slowest")
        for stage, times in {**self.stages_s, "whole frame": self.frame_s}.items():
            low, middle, high = (1000 * seconds for seconds in (min(times), median(times), max(times)))
            lines.append(f"{stage:<22}{middle:>10.1f}  {low:.1f} to {high:.1f}")
        frame_s, gemm = median(self.frame_s), self.limits.gemm_gflops
        run_ms, memory = 1000 * self.run_frame_s, self.peak_memory_bytes / 1e6
        lines += [
            "",
            f"{1 / frame_s:.3g} frames a second by the model alone",
            f"{run_ms:.0f} ms a frame with reading and recording, {self.run_frame_s / frame_s:.2f} times the model's",
            f"{self.operations / 1e9:.0f} G operations a frame; matrix products run at {gemm:.0f} G a second: "
            f"the frame takes {self.times_limit:.2f} times as long as that",
            f"memory is copied at {self.limits.copy_gbs:.1f} GB/s; at most {memory:.0f} MB were in use",
        ]
        return "\n".join(lines + self._comparison_lines())

    def _comparison_lines(self) -> list[str]:
        if self.comparison is None:
            return []
        found = self.comparison
        return [
            f"the plain version takes {1000 * median(found.plain_frame_s):.0f} ms, {self.speedup:.2f} times as long",
            f"boxes are at most {found.max_box_difference_m:.2g} m apart, {found.share_within_tenth_m:.1%} of them "
            f"within 0.1 m; scores at most {found.max_score_difference:.2g}",
        ]
