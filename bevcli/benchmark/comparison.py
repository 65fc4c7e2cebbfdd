"""The fast version and the plain one, frame by frame in turn."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from bevcli.benchmark.result import Comparison
from bevcli.benchmark.version import Version
from bevcli.model.bevformer import BEVFormer
from bevcli.model.prepared import textbook_version
from bevcli.pipeline.cpu_memory import keep_freed_memory, return_freed_memory
from bevcli.pipeline.preprocess import PreparedFrame

NEAR_M = 0.1


def compare_with_plain(
    model: BEVFormer, fast: Version, frames: Iterable[PreparedFrame]
) -> tuple[Comparison, tuple[float, ...]]:
    """Both versions on the same frames, each with its own history. Also returns the fast one's times.

    The plain one runs with the C library's own memory settings, as any PyTorch model would: to keep freed memory is
    part of the fast version, which therefore takes an untimed step first, to have some to keep.
    """
    device = fast.runner.device
    plain = Version(textbook_version(model, device), device)
    fast.start_anew()
    apart, scores_apart = [], []
    for prepared in frames:
        if device.type == "cpu":
            return_freed_memory()
        plain.step(prepared)
        if device.type == "cpu":
            keep_freed_memory()
        fast.warm_up(prepared)
        fast.step(prepared)
        apart.append((fast.centers - plain.centers).norm(dim=-1))
        scores_apart.append((fast.scores - plain.scores).abs().max())
    distances = torch.cat(apart)
    comparison = Comparison(
        plain_frame_s=tuple(plain.seconds),
        max_box_difference_m=float(distances.max()),
        share_within_tenth_m=float((distances <= NEAR_M).float().mean()),
        max_score_difference=float(torch.stack(scores_apart).max()),
    )
    return comparison, tuple(fast.seconds)
