"""The prepared model next to the plain one, on the same frames."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from bevcli.benchmark.result import Comparison
from bevcli.benchmark.textbook import textbook_version
from bevcli.benchmark.version import Version
from bevcli.model.bevformer import BEVFormerBase
from bevcli.pipeline.cpu_memory import keep_freed_memory, return_freed_memory
from bevcli.pipeline.preprocess import PreparedFrame

NEAR_M = 0.1


def compare_with_plain(
    model: BEVFormerBase, fast: Version, frames: Iterable[PreparedFrame]
) -> tuple[Comparison, tuple[float, ...]]:
    """Runs both versions on each frame in turn, each with its own history.

    On a CPU the plain version runs with the C library's default memory settings, as any PyTorch model would. Keeping
    freed memory is part of the fast version. It therefore runs one step untimed before each timed one, to have memory
    to reuse.

    Args:
        model: the model with its weights.
        fast: its prepared version.
        frames: inputs of both.

    Returns:
        The comparison, and the seconds of each frame of the fast version.
    """
    device = fast.runner.device
    plain = Version(textbook_version(model, device), device)
    fast.start_anew()
    distances_m, score_differences = [], []
    for prepared in frames:
        if device.type == "cpu":
            return_freed_memory()
        plain.step(prepared)
        if device.type == "cpu":
            keep_freed_memory()
        fast.warm_up(prepared)
        fast.step(prepared)
        distances_m.append((fast.centers - plain.centers).norm(dim=-1))
        score_differences.append((fast.scores - plain.scores).abs().max())
    distances = torch.cat(distances_m)
    comparison = Comparison(
        plain_frame_s=tuple(plain.seconds),
        max_box_difference_m=float(distances.max()),
        share_within_tenth_m=float((distances <= NEAR_M).float().mean()),
        max_score_difference=float(torch.stack(score_differences).max()),
    )
    return comparison, tuple(fast.seconds)
