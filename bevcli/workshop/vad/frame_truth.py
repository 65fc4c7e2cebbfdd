"""The ground truth beyond boxes of a frame to train on: lines, futures and the driven path."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Frame, Sequence, result_of
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.workshop.training.targets import boxes_inside
from bevcli.workshop.vad.config import VADConfig
from bevcli.workshop.vad.driving_scores import LATE_S, FramesByTime, followed, with_true_futures
from bevcli.workshop.vad.map_lines import TRUE_LINES, MapLines


@dataclass(frozen=True)
class FrameTruth:
    """The ground truth of one frame, bev frame.

    Attributes:
        boxes: the G boxes to be found, each with one future of T steps; NaN from the step on in which the object is
            not there.
        lines: of the map.
        driven: (T, 2) places where the vehicle was at the same times, metres; NaN after the end of the scene.
        command: the driver's command that the driven path follows; "" where no place is known.
    """

    boxes: Boxes3D
    lines: MapLines
    driven: Array
    command: str


def missing_truth(frame: Frame, config: VADConfig) -> tuple[str, str] | None:
    """The truth beyond boxes that a frame lacks, in words, and its file; None where nothing is missing."""
    return ("lines", TRUE_LINES) if result_of(MapLines, frame.ground_truth_results) is None else None


def frame_truth(frame: Frame, sequence: Sequence, place: int, config: VADConfig) -> FrameTruth:
    """The truth of a frame that a model trains on.

    frame: with ground truth boxes, and the rig that the model sees; at `place` of its drive, `sequence`.
    Raises InputError where the frame has no true lines, or its objects have no identities.
    """
    assert frame.ground_truth is not None
    times, boxes = config.future_times_s, frame.ground_truth
    lines = result_of(MapLines, frame.ground_truth_results)
    if lines is None:
        raise InputError(
            f"frame {frame.stamp.index} of {frame.stamp.scene or 'the drive'} has no true lines of the map: training "
            f"{config.name} needs {TRUE_LINES} (bevcli render writes it)"
        )
    later = FramesByTime(_frames_until(sequence, place, max(times)))
    bev_from_world = inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev)
    boxes = with_true_futures(boxes, frame.stamp, later, times)
    driven = np.full((len(times), 2), np.nan)
    for step, seconds in enumerate(times):
        there = later.after(frame.stamp, seconds)
        if there is not None and there.world_from_ego is not None:
            driven[step] = apply(bev_from_world, (there.world_from_ego.matrix @ frame.rig.ego_from_bev)[:3, 3])[:2]
    boxes = boxes_inside(boxes.transformed(bev_from_world), config)
    known = driven[np.isfinite(driven).all(-1)]
    return FrameTruth(boxes, lines, driven, followed(known, config.commands) if len(known) else "")


def _frames_until(sequence: Sequence, place: int, seconds: float) -> Iterator[FrameBoxes]:
    """The frames of the same scene from a place on, and up to so many seconds later."""
    now = sequence.stamps[place]
    last_ns = now.timestamp_ns + round((seconds + LATE_S) * 1e9)
    for later, stamp in enumerate(sequence.stamps):
        if stamp.scene == now.scene and now.timestamp_ns <= stamp.timestamp_ns <= last_ns:
            frame = sequence.ground_truth_frame(later)
            boxes = Boxes3D.empty() if frame.ground_truth is None else frame.ground_truth
            yield FrameBoxes(stamp, frame.world_from_ego, boxes)
