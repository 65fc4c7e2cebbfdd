"""Scores of lines of the map, forecasts and planned paths of a run, from its files and the ground truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from bevcli.errors import InputError
from bevcli.evaluation.inputs import ScoredInput
from bevcli.evaluation.map_lines import LineScores, evaluate_lines
from bevcli.evaluation.motion import MotionScores, evaluate_motion
from bevcli.evaluation.pairing import FramePairs
from bevcli.evaluation.planning import PlannedFrame, PlanScores, evaluate_plans
from bevcli.evaluation.true_futures import Drives, with_true_futures
from bevcli.frame import Plan
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.sequences.files.json_fields import pose_from_json
from bevcli.sequences.files.lines_file import LinesFile, LinesWriter, read_lines
from bevcli.sequences.files.plan_file import PlanWriter, read_plans

Scored = Literal["map", "motion", "plan"]
DRIVING: tuple[Scored, ...] = ("map", "motion", "plan")
TURN_M = 2.0  # a path that ends further to a side is one to the right or left, as in nuScenes' labels for VAD


@dataclass(frozen=True)
class DrivingScores:
    """Scores that were asked for; the others are None. notes: what was assumed or left out."""

    lines: LineScores | None = None
    motion: MotionScores | None = None
    plan: PlanScores | None = None
    notes: tuple[str, ...] = ()


def evaluate_driving(
    asked: Sequence[Scored], predictions: Path, found: ScoredInput, truth: ScoredInput, pairs: FramePairs
) -> DrivingScores:
    """Score what is asked for.

    predictions: a folder, or a file in it. Raises InputError where a side lacks what is asked for.
    """
    folder = predictions if predictions.is_dir() else predictions.parent
    scores = DrivingScores()
    if "map" in asked:
        assert truth.lines is not None
        scores = replace(scores, lines=_lines(read_lines(folder / LinesWriter.name), truth.lines(), pairs))
    if "motion" in asked:
        _require_world(pairs, "motion")
        scores = replace(scores, motion=_motion(found, truth, pairs))
    if "plan" in asked:
        _require_world(pairs, "plan")
        plan, notes = _plan(folder / PlanWriter.name, found, truth, pairs)
        scores = replace(scores, plan=plan, notes=notes)
    return scores


def _require_world(pairs: FramePairs, option: str) -> None:
    if pairs.frame_of_reference != "world":
        raise InputError(f"`{option}`: needs boxes in the world frame (found the {pairs.frame_of_reference} frame)")


def _drives(truth: ScoredInput) -> Drives:
    if truth.boxes.frame_of_reference != "world":
        raise InputError(
            "forecasts and paths need ground truth in the world frame "
            f"(found the {truth.boxes.frame_of_reference} frame)"
        )
    return Drives(truth.boxes.frames)


def _lines(found: LinesFile, true: LinesFile, pairs: FramePairs) -> LineScores:
    if found.frame_of_reference != true.frame_of_reference:
        raise InputError(
            f"`map`: predicted lines are in the {found.frame_of_reference} frame, true ones in the "
            f"{true.frame_of_reference} frame (expected the same)"
        )
    found_of, true_of = ({frame.stamp: frame.lines for frame in file.frames} for file in (found, true))
    stamps = zip(pairs.prediction_stamps, pairs.ground_truth_stamps, strict=True)
    lines = [(found_of[one], true_of[other]) for one, other in stamps if one in found_of and other in true_of]
    if not lines:
        raise InputError("`map`: no frame has both predicted and true lines")
    return evaluate_lines(lines, true.classes)


def _motion(found: ScoredInput, truth: ScoredInput, pairs: FramePairs) -> MotionScores:
    drives = _drives(truth)
    times = _times(pairs.predictions)
    areas = _areas(found, pairs)
    return evaluate_motion(
        (inside(boxes, area), inside(with_true_futures(true, stamp, drives, times), area))
        for boxes, true, stamp, area in zip(
            pairs.predictions, pairs.ground_truth, pairs.ground_truth_stamps, areas, strict=True
        )
    )


def _times(predictions: Sequence[Boxes3D]) -> Array:
    """(T,) seconds of the steps of the predicted futures."""
    for boxes in predictions:
        if boxes.futures is not None and len(boxes):
            times: Array = boxes.futures[0, 0, :, 0]
            return times
    raise InputError('`motion`: the predictions have no "futures" (expected those of a model that forecasts)')


@dataclass(frozen=True)
class Area:
    """The area that a model sees: bev_from_world (4, 4), and the ranges of x and y in the bev frame, metres."""

    bev_from_world: Array
    low: Array
    high: Array


def inside(boxes: Boxes3D, area: Area) -> Boxes3D:
    """The boxes, in the world frame, whose centre is in the area."""
    centers = apply(area.bev_from_world, boxes.centers)[:, :2]
    return boxes[((centers >= area.low) & (centers <= area.high)).all(1)]


def _areas(found: ScoredInput, pairs: FramePairs) -> Iterator[Area]:
    extras = found.boxes.extras
    ranges = [extras.get(key, [-np.inf, np.inf]) for key in ("x_range_m", "y_range_m")]
    low, high = np.array(ranges, dtype=np.float64).T
    of_stamp = {frame.stamp: frame for frame in found.boxes.frames}
    for stamp, world_from_ego in zip(pairs.prediction_stamps, pairs.reference_from_ego, strict=True):
        yield Area(inverse(world_from_ego @ ego_from_bev_of(of_stamp[stamp])), low, high)


def ego_from_bev_of(frame: FrameBoxes) -> Array:
    """(4, 4), that a frame states, or else nuScenes'."""
    stated = frame.extras.get("ego_from_bev")
    if stated is None:
        return default_ego_from_bev()
    return pose_from_json(stated, "ego_from_bev", f"frame {frame.stamp.index}").matrix


def _plan(file: Path, found: ScoredInput, truth: ScoredInput, pairs: FramePairs) -> tuple[PlanScores, tuple[str, ...]]:
    plans = {planned.stamp: planned for planned in read_plans(file)}
    of_stamp = {frame.stamp: frame for frame in found.boxes.frames}
    drives, frames, left_out, guessed, times = _drives(truth), [], 0, 0, np.zeros(0)
    stamps = zip(pairs.prediction_stamps, pairs.ground_truth_stamps, pairs.reference_from_ego, strict=True)
    for stamp, true_stamp, world_from_ego in stamps:
        if stamp not in plans:
            continue
        if plans[stamp].frame_of_reference != "world":
            raise InputError(f"{file}: `plan`: needs paths in the world frame (found the ego frame)")
        plan, ego_from_bev = plans[stamp].plan, ego_from_bev_of(of_stamp[stamp])
        later = [drives.after(true_stamp, seconds) for seconds in plan.times_s]
        if any(frame is None for frame in later):
            left_out += 1
            continue
        times, guessed = plan.times_s, guessed + (not plan.command)
        frames.append(_planned(plan, world_from_ego @ ego_from_bev, ego_from_bev, [f for f in later if f is not None]))
    if not frames:
        raise InputError(f"{file}: `plan`: no frame has a planned path and {max(times, default=3):g} s of ground truth")
    notes = [f"{left_out} frames at the end of scenes have no whole driven path: left out"] if left_out else []
    if guessed:
        notes.append(f"{guessed} frames have no command: the path of the command that the driver followed is scored")
    return evaluate_plans(frames, len(times), float(times[0])), tuple(notes)


def _planned(plan: Plan, world_from_bev: Array, ego_from_bev: Array, later: Sequence[FrameBoxes]) -> PlannedFrame:
    bev_from_world = inverse(world_from_bev)
    origins = [frame.world_from_ego.matrix @ ego_from_bev[:, 3] for frame in later if frame.world_from_ego is not None]
    driven = apply(bev_from_world, np.array(origins)[:, :3])[:, :2]
    command = plan.command or followed(driven, plan.commands)
    path = apply(bev_from_world, plan.paths[plan.commands.index(command)])[:, :2]
    return PlannedFrame(path, driven, [frame.boxes.transformed(bev_from_world) for frame in later])


def followed(driven: Array, commands: Sequence[str]) -> str:
    """The command that a driven path (T, 2) follows, by its last place; the first command where that is unknown."""
    across = driven[-1, 0]
    command = "right" if across >= TURN_M else "left" if across <= -TURN_M else "straight"
    return command if command in commands else commands[0]
