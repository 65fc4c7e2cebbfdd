"""Differences of the boxes of an exported file from those of the model in PyTorch."""

from collections.abc import Iterable

import msgspec
import torch

from bevcli.model.step import ModelOutputs

SHOWN = 0.25  # boxes with a lower score are not shown by default
NEAR_M = 0.1
CENTER = (0, 1, 4)  # columns of box codes


class BoxDifferences(msgspec.Struct, frozen=True):
    """Differences of an exported file from the model in PyTorch and float32, over the boxes that this shows.

    Attributes:
        frames: number of frames that were compared.
        boxes: number of boxes.
        near: share of them whose centres differ by at most 0.1 m, 0 to 1.
        median_m: median of the distances of the centres, metres.
        largest_m: the largest of them.
        score: the largest difference of their scores.
    """

    frames: int
    boxes: int
    near: float
    median_m: float
    largest_m: float
    score: float

    def text(self) -> str:
        """One line."""
        if not self.boxes:
            return f"no boxes to compare in {self.frames} frames"
        return (
            f"{self.boxes} boxes in {self.frames} frames: centres differ by {self.median_m:.2g} m in the median and "
            f"{self.largest_m:.2g} m at most, {self.near:.1%} by at most 0.1 m; scores by at most {self.score:.2g}"
        )


def box_differences(steps: Iterable[tuple[ModelOutputs, ModelOutputs]]) -> BoxDifferences:
    """The differences over some frames. steps: outputs in PyTorch and of the file, whose queries are the same ones."""
    distances, scores, frames = [torch.zeros(0)], [torch.zeros(0)], 0
    for ours, theirs in steps:
        frames += 1
        ours_scores, theirs_scores = ours.class_logits[-1, 0].sigmoid(), theirs.class_logits[-1, 0].sigmoid()
        shown = ours_scores.amax(-1) >= SHOWN  # (Q,)
        moved = (ours.box_codes[-1, 0] - theirs.box_codes[-1, 0])[shown][:, CENTER]
        distances.append(moved.norm(dim=-1).cpu())
        scores.append((ours_scores - theirs_scores)[shown].abs().amax(-1).cpu())
    metres, off = torch.cat(distances), torch.cat(scores)
    if not len(metres):
        return BoxDifferences(frames, 0, 1.0, 0.0, 0.0, 0.0)
    near = (metres <= NEAR_M).float().mean()
    return BoxDifferences(frames, len(metres), *(float(x) for x in (near, metres.median(), metres.max(), off.max())))
