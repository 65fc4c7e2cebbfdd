"""`estimate_score`: runs a model over a drive and tells how good its boxes are likely to be, without ground truth."""

from collections.abc import Callable
from dataclasses import dataclass

from bevcli.findings import Finding
from bevcli.frame import Sequence
from bevcli.inference.load import Model
from bevcli.inference.run import run
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.workshop.trust.figures import Figures, figures_of


@dataclass(frozen=True)
class EstimatedScore:
    """The score that a model is likely to have on a drive without ground truth.

    Attributes:
        nd_score: estimated NDS, 0 to 1; None for weights whose figures were never compared with a true NDS.
        low: lower end of the interval that holds the true NDS in 9 of 10 drives; None without `nd_score`.
        high: its upper end.
        figures: what it was made of.
        findings: faults that show without labels.
    """

    nd_score: float | None
    low: float | None
    high: float | None
    figures: Figures
    findings: tuple[Finding, ...] = ()


def estimate_score(
    model: Model, drive: Sequence, *, temporal: bool = True, after_frame: Callable[[], None] = lambda: None
) -> EstimatedScore:
    """The score that a model is likely to have on a drive; the drive needs no ground truth.

    Args:
        model: of `load_model`.
        drive: of `open_sequence`.
        temporal: use the frames before.
        after_frame: called after each frame.

    Raises InputError where a frame cannot be read.
    """
    frames = []
    for frame, prediction in run(model, drive, temporal=temporal, track=False):
        frames.append(FrameBoxes(frame.stamp, frame.world_from_ego, prediction.boxes_ego))
        after_frame()
    figures = figures_of(frames, drive.rig, model.config.bev_grid.nearest_side_m)
    return EstimatedScore(None, None, None, figures)
