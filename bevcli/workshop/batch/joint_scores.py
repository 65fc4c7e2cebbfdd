"""Joint scores of several drives, from the matching of each drive: as if all frames had been scored together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevcli.evaluation.detection import ClassMatches, DetectionScores, with_all_columns
from bevcli.evaluation.evaluate import FrameScores, SegmentationScores
from bevcli.evaluation.matching import DetectionConfig, ScoredBoxes
from bevcli.geometry.boxes import Boxes3D


@dataclass(frozen=True)
class DriveMatches:
    """The part of one drive's scores that the joint scores need.

    Attributes:
        frame_count: number of frames that were scored.
        matches: by class, the matching of its boxes.
        unmeasured: names of errors whose quantity no ground truth of the drive has.
        segmentation: the scores of its maps, None without maps.
    """

    frame_count: int
    matches: tuple[ClassMatches, ...]
    unmeasured: tuple[str, ...]
    segmentation: SegmentationScores | None


def score_jointly(drives: Sequence[DriveMatches], config: DetectionConfig) -> FrameScores:
    """The scores over all frames of the drives: AP of all boxes together, not a mean of the drives' scores.

    drives: at least one. config: the parameters with which every drive was matched.
    """
    matches = tuple(_merged([drive.matches[i] for drive in drives]) for i in range(len(config.class_ranges_m)))
    measured = [set(drive.unmeasured) for drive in drives if any(len(part.ground_truth) for part in drive.matches)]
    unmeasured = set.intersection(*measured) if measured else set()
    names = tuple(name for name in ("vel_err", "attr_err") if name in unmeasured)
    detection = DetectionScores(sum(drive.frame_count for drive in drives), matches, names, config)
    maps = [drive.segmentation for drive in drives if drive.segmentation is not None]
    return FrameScores(detection, _merged_maps(maps) if maps else None)


def _merged(parts: Sequence[ClassMatches]) -> ClassMatches:
    """The matching of one class in all drives. Equal scores stay in the order of a joint matching."""
    starts = np.cumsum([0, *(len(part.ground_truth) for part in parts)])
    moved = [np.where(p.matched < 0, -1, p.matched + start) for p, start in zip(parts, starts, strict=False)]
    # Of equal scores the later one is first, as in `descending_scores`: the last drive comes first.
    predictions = _concatenated([part.predictions for part in parts[::-1]])
    order = np.argsort(-predictions.column("scores"), kind="stable")
    return ClassMatches(
        parts[0].name,
        _concatenated([part.ground_truth for part in parts]),
        predictions[order],
        np.concatenate(moved[::-1], axis=1)[:, order],
        np.concatenate([part.truth_counts for part in parts]),
        np.concatenate([part.counts for part in parts[::-1]], axis=1)[:, order],
    )


def _concatenated(parts: Sequence[ScoredBoxes]) -> ScoredBoxes:
    """The boxes of all drives; their frames are not numbered anew."""
    boxes = with_all_columns(Boxes3D.concatenate(part.boxes for part in parts))
    frames = np.concatenate([part.frames for part in parts])
    return ScoredBoxes(boxes, frames, np.concatenate([part.ranges_m for part in parts]))


def _merged_maps(parts: Sequence[SegmentationScores]) -> SegmentationScores:
    names = dict.fromkeys(name for part in parts for name in part.union)
    return SegmentationScores(
        {name: sum(part.intersection.get(name, 0.0) for part in parts) for name in names},
        {name: sum(part.union.get(name, 0.0) for part in parts) for name in names},
        sum(part.frame_count for part in parts),
    )
