"""The ground truth beyond boxes of a frame to train on, for models with heads of their own."""

from collections.abc import Iterator

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Frame, Sequence, result_of
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import apply, inverse
from bevcli.model.config import ModelConfig
from bevcli.model.step import FrameTruth
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.workshop.training.detection_loss import boxes_inside
from bevcli.workshop.vad.driving_scores import LATE_S, Drives, followed, with_true_futures
from bevcli.workshop.vad.map_lines import TRUE_LINES, MapLines
from bevcli.workshop.vad.plan import Plan

NO_LINES = MapLines((), np.zeros(0, dtype=np.str_))


def frame_truth(frame: Frame, sequence: Sequence, place: int, config: ModelConfig) -> FrameTruth:
    """The truth of a frame that a model trains on.

    frame: with ground truth boxes, and the rig that the model sees; at `place` of its drive, `sequence`.
    Raises InputError where the frame has no true lines but the model finds lines, or its objects have no identities.
    """
    assert frame.ground_truth is not None
    times, boxes = config.future_times_s, frame.ground_truth
    lines = result_of(MapLines, frame.ground_truth_results)
    if MapLines in config.results and lines is None:
        raise InputError(
            f"frame {frame.stamp.index} of {frame.stamp.scene or 'the drive'} has no true lines of the map: training "
            f"{config.name} needs {TRUE_LINES} (bevcli render writes it)"
        )
    later = Drives(_frames_until(sequence, place, max(times, default=0.0)))
    bev_from_world = inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev)
    if times:
        boxes = with_true_futures(boxes, frame.stamp, later, times)
    driven = np.full((len(times), 2), np.nan)
    for step, seconds in enumerate(times):
        there = later.after(frame.stamp, seconds)
        if there is not None and there.world_from_ego is not None:
            driven[step] = apply(bev_from_world, (there.world_from_ego.matrix @ frame.rig.ego_from_bev)[:3, 3])[:2]
    boxes = boxes_inside(boxes.transformed(bev_from_world), config)
    known, commands = driven[np.isfinite(driven).all(-1)], config.results.get(Plan, ())
    command = followed(known, commands) if len(known) and commands else ""
    return FrameTruth(boxes, NO_LINES if lines is None else lines, driven, command)


def _frames_until(sequence: Sequence, place: int, seconds: float) -> Iterator[FrameBoxes]:
    """The frames of the same scene from a place on, and up to so many seconds later."""
    now = sequence.stamps[place]
    last_ns = now.timestamp_ns + round((seconds + LATE_S) * 1e9)
    for later, stamp in enumerate(sequence.stamps):
        if stamp.scene == now.scene and now.timestamp_ns <= stamp.timestamp_ns <= last_ns:
            frame = sequence.ground_truth_frame(later)
            boxes = Boxes3D.empty() if frame.ground_truth is None else frame.ground_truth
            yield FrameBoxes(stamp, frame.world_from_ego, boxes)
