"""Scores of lines of the map, forecasts and planned paths of a run, from its files and the ground truth.

The futures of true objects are the places where the same objects are in later frames of the ground truth.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp, Ground, result_of
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.printing import counted, number
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.sequences.files.json_fields import pose_from_json
from bevcli.workshop.formats import is_nuscenes_root
from bevcli.workshop.formats.map_lines import LINE_CLASSES, LINES_FILE, FrameLines, LinesFile, MapLines, read_lines
from bevcli.workshop.scores import ResultOptions
from bevcli.workshop.scores.inputs import Compared, FramePairs, ScoredInput
from bevcli.workshop.scores.tables import Table
from bevcli.workshop.vad import driving_metrics as metrics
from bevcli.workshop.vad.plan import Plan, read_plans

TURN_M = 2.0  # a path that ends further to a side is one to the right or left, as in nuScenes' labels for VAD
LATE_S = 0.1  # a frame this near counts as one at the time of a step


class FramesByTime:
    """The frames of a ground truth by scene and time, with boxes in the world frame."""

    def __init__(self, truth: Iterable[FrameBoxes]) -> None:
        self._scenes: dict[str, list[FrameBoxes]] = {}
        for frame in sorted(truth, key=lambda frame: frame.stamp.timestamp_ns):
            self._scenes.setdefault(frame.stamp.scene, []).append(frame)
        self._times = {
            scene: np.array([frame.stamp.timestamp_ns for frame in frames]) for scene, frames in self._scenes.items()
        }

    def after(self, stamp: FrameStamp, seconds: float) -> FrameBoxes | None:
        """The frame of the same scene so many seconds later; None where there is none within LATE_S."""
        time_ns = stamp.timestamp_ns + round(seconds * 1e9)
        times = self._times[stamp.scene]
        nearest = int(np.abs(times - time_ns).argmin())
        return self._scenes[stamp.scene][nearest] if abs(times[nearest] - time_ns) <= LATE_S * 1e9 else None


def with_true_futures(
    boxes: Boxes3D, stamp: FrameStamp, drives: FramesByTime, times_s: Sequence[float] | Array
) -> Boxes3D:
    """Boxes in the world frame with one future each: NaN from the first step on in which the object is not there.

    Raises InputError where the boxes have no identities.
    """
    if len(boxes) and boxes.instances is None:
        raise InputError(f'frame {stamp.index}: true boxes have no "instance": futures need identities')
    places = np.full((len(boxes), 1, len(times_s), 2), np.nan)
    alive = np.ones(len(boxes), dtype=bool)
    for step, seconds in enumerate(times_s):
        frame = drives.after(stamp, seconds)
        later = Boxes3D.empty() if frame is None else frame.boxes
        names = () if later.instances is None else later.instances
        row_of = {name: index for index, name in enumerate(names) if name}
        for row, name in enumerate(() if boxes.instances is None else boxes.instances):
            alive[row] &= name in row_of
            if alive[row]:
                places[row, 0, step] = later.centers[row_of[name], :2]
    seconds = np.broadcast_to(np.asarray(times_s)[:, None], (*places.shape[:3], 1))
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1))


@dataclass(frozen=True)
class DrivingScores:
    """Scores that were asked for; the others are None. notes: what was assumed or left out."""

    lines: metrics.LineScores | None = None
    motion: Mapping[str, metrics.MotionSums] | None = None
    plan: metrics.PlanScores | None = None
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        content: dict[str, Any] = {}
        if (lines := self.lines) is not None:
            aps = {name: {f"{limit:.1f}": ap for limit, ap in of_class.items()} for name, of_class in lines.ap.items()}
            content["map"] = {
                "mean_ap": lines.mean_ap,
                "label_aps": aps,
                "mean_dist_aps": lines.mean_by_class,
                "ground_truth_lines": dict(lines.truth_count),
                "frames": lines.frame_count,
            }
        if (motion := self.motion) is not None:
            content["motion"] = {name: {**sums.metrics, "ground_truth": sums.truths} for name, sums in motion.items()}
        if (plan := self.plan) is not None:
            content["plan"] = {
                "averaged_up_to_horizon": _horizons(plan, averaged=True),
                "at_horizon": _horizons(plan, averaged=False),
                "frames": len(plan.distances_m),
            }
        return content

    def tables(self) -> Iterator[Table]:
        """One table for each kind of scores that was asked for."""
        if (lines := self.lines) is not None:
            rows: list[tuple[str | float, ...]] = [
                (name, lines.truth_count[name], lines.mean_by_class[name], *of_class.values())
                for name, of_class in lines.ap.items()
            ]
            columns = ("map line", "lines", "AP", *(f"AP@{limit:g}m" for limit in metrics.THRESHOLDS_M))
            below = f"\n\nmap mAP {number(lines.mean_ap)} ({counted(lines.frame_count, 'frames')})"
            yield Table("lines of the map", columns, rows, below=below, sums={"map mAP": lines.mean_ap})
        if (motion := self.motion) is not None:
            rows = [(name, sums.truths, *map(float, sums.metrics.values())) for name, sums in motion.items()]
            yield Table("forecasts", ("forecasts", "objects", "EPA", "minADE m", "minFDE m", "miss rate"), rows)
        if (plan := self.plan) is not None:
            averaged = _horizons(plan, averaged=True)
            at = _horizons(plan, averaged=False)
            rows, seconds = [], tuple(averaged["L2"])
            for name, unit, factor in (("L2", "m", 1), ("collision", "%", 100)):
                cells = [[float(factor * value) for value in of[name].values()] for of in (averaged, at)]
                rows.append((f"{name} {unit}", *cells[0], "", *cells[1]))
            names = ("", *(f"mean up to {end}" for end in seconds), "", *(f"at {end}" for end in seconds))
            explained = "left: mean up to the horizon (ST-P3, VAD); right: at the horizon, vehicles only (UniAD)"
            below = f"\n({len(plan.distances_m)} paths; {explained})"
            yield Table("planned paths", ("planned path", *seconds, "", *seconds), rows, names=names, below=below)


def _horizons(plan: metrics.PlanScores, *, averaged: bool) -> dict[str, dict[str, float]]:
    """Distances and shares of collisions by horizon: averaged up to it (ST-P3, VAD), or at it, of vehicles (UniAD)."""
    score = plan.averaged if averaged else plan.at
    collisions = plan.collisions if averaged else plan.collisions_with_vehicles
    seconds = [s for s in (1, 2, 3) if s <= plan.step_s * plan.distances_m.shape[1] + 1e-6]
    return {
        "L2": {f"{s}s": score(plan.distances_m, s) for s in seconds},
        "collision": {f"{s}s": score(collisions, s) for s in seconds},
    }


def evaluate_driving(options: ResultOptions, compared: Compared) -> DrivingScores:
    """Score what the options ask for. Raises InputError where a side lacks it."""
    predicted, truth, pairs = compared.predictions, compared.truth, compared.pairs
    assert predicted is not None
    assert truth is not None
    lines = _lines(predicted.path.with_name(MapLines.file_name), truth, pairs) if options.map else None
    motion = _motion(predicted, truth, pairs) if options.motion else None
    plan, notes = _plan(predicted.path.with_name(Plan.file_name), truth, pairs) if options.plan else (None, ())
    return DrivingScores(lines, motion, plan, notes)


def _drives(truth: ScoredInput, pairs: FramePairs, option: str) -> FramesByTime:
    """The drives of the ground truth, which an option needs in the world frame."""
    if pairs.frame_of_reference != "world":
        raise InputError(
            f"`{option}` (`--{option}`): needs boxes in the world frame (found the {pairs.frame_of_reference} frame)"
        )
    if truth.boxes.frame_of_reference != "world":
        raise InputError(
            "forecasts and paths need ground truth in the world frame "
            f"(found the {truth.boxes.frame_of_reference} frame)"
        )
    return FramesByTime(truth.boxes.frames)


def _lines(file: Path, truth: ScoredInput, pairs: FramePairs) -> metrics.LineScores:
    predicted, true = read_lines(file), _true_lines(truth)
    if predicted.frame_of_reference != true.frame_of_reference:
        raise InputError(
            f"`map` (`--map`): predicted lines are in the {predicted.frame_of_reference} frame, true ones in the "
            f"{true.frame_of_reference} frame (expected the same)"
        )
    predicted_of, true_of = ({frame.stamp: frame.lines for frame in side.frames} for side in (predicted, true))
    stamps = [(one.stamp, other.stamp) for one, other in zip(pairs.predictions, pairs.ground_truth, strict=True)]
    lines = [(predicted_of[one], true_of[other]) for one, other in stamps if one in predicted_of and other in true_of]
    if not lines:
        raise InputError("`map` (`--map`): no frame has both predicted and true lines")
    return metrics.evaluate_lines(lines, true.classes)


def _true_lines(truth: ScoredInput) -> LinesFile:
    """The true lines of the map: those next to a boxes file, or those of a drive in the world frame."""
    if truth.open_drive is None:
        file = truth.path.with_name(LINES_FILE)
        if not file.exists():
            raise InputError(
                f"{file}: `map` (`--map`): the file is missing (expected true lines, as `bevcli render` writes them)"
            )
        return read_lines(file)
    drive, frames = truth.open_drive(), []
    for frame in map(drive.ground_truth_frame, range(len(drive.stamps))):
        if (lines := result_of(MapLines, frame.ground_truth_results)) is None:
            expansion = f"the map expansion in {truth.path / 'maps' / 'expansion'}"
            expected = expansion if is_nuscenes_root(truth.path) else "a drive that has them"
            frame_name = f'scene "{frame.stamp.scene}"' if frame.stamp.scene else f"frame {frame.stamp.index}"
            raise InputError(
                f"{drive.name}: `map` (`--map`): {frame_name} has no true lines of the map (expected {expected})"
            )
        ground = Ground(frame.stamp, frame.rig.ego_from_bev, frame.world_from_ego)
        frames.append(FrameLines(frame.stamp, replace(lines, points=tuple(map(ground.points, lines.points)))))
    return LinesFile("world", LINE_CLASSES, tuple(frames))


def _motion(predicted: ScoredInput, truth: ScoredInput, pairs: FramePairs) -> dict[str, metrics.MotionSums]:
    """The scores of forecasts of the objects whose centre is in the area that the model sees."""
    drives, times = _drives(truth, pairs, "motion"), _times(pairs.predictions)
    ranges = [predicted.boxes.extras.get(key, [-np.inf, np.inf]) for key in ("x_range_m", "y_range_m")]
    low, high = np.array(ranges, dtype=np.float64).T

    def inside(boxes: Boxes3D, bev_from_world: Array) -> Boxes3D:
        centers = apply(bev_from_world, boxes.centers)[:, :2]
        return boxes[((centers >= low) & (centers <= high)).all(1)]

    def scored(predicted: FrameBoxes, true: FrameBoxes, world_from_ego: Array) -> tuple[Boxes3D, Boxes3D]:
        bev_from_world = inverse(world_from_ego @ ego_from_bev_of(predicted))
        with_futures = with_true_futures(true.boxes, true.stamp, drives, times)
        return inside(predicted.boxes, bev_from_world), inside(with_futures, bev_from_world)

    return metrics.evaluate_motion(map(scored, pairs.predictions, pairs.ground_truth, pairs.reference_from_ego))


def _times(predictions: Sequence[FrameBoxes]) -> Array:
    """(T,) seconds of the steps of the predicted futures."""
    for frame in predictions:
        if frame.boxes.futures is not None and len(frame.boxes):
            return np.asarray(frame.boxes.futures[0, 0, :, 0])
    raise InputError(
        '`motion` (`--motion`): the predictions have no "futures" (expected those of a model that forecasts)'
    )


def ego_from_bev_of(frame: FrameBoxes) -> Array:
    """(4, 4), that a frame states, or else nuScenes'."""
    pose = frame.extras.get("ego_from_bev")
    if pose is None:
        return default_ego_from_bev()
    return pose_from_json(pose, "ego_from_bev", f"frame {frame.stamp.index}").matrix


def _plan(file: Path, truth: ScoredInput, pairs: FramePairs) -> tuple[metrics.PlanScores, tuple[str, ...]]:
    drives, frames, left_out, guessed, times = _drives(truth, pairs, "plan"), [], 0, 0, np.zeros(0)
    plans = {planned.stamp: planned for planned in read_plans(file)}
    for predicted, true, world_from_ego in zip(
        pairs.predictions, pairs.ground_truth, pairs.reference_from_ego, strict=True
    ):
        if predicted.stamp not in plans:
            continue
        planned = plans[predicted.stamp]
        if planned.frame_of_reference != "world":
            raise InputError(f"{file}: `plan` (`--plan`): needs paths in the world frame (found the ego frame)")
        plan, ego_from_bev = planned.plan, ego_from_bev_of(predicted)
        later = [frame for seconds in plan.times_s if (frame := drives.after(true.stamp, seconds)) is not None]
        if len(later) < len(plan.times_s):
            left_out += 1
            continue
        times, guessed = plan.times_s, guessed + (not plan.command)
        bev_from_world = inverse(world_from_ego @ ego_from_bev)
        known = [frame.world_from_ego for frame in later if frame.world_from_ego is not None]
        origins = [pose.matrix @ ego_from_bev[:, 3] for pose in known]
        driven = apply(bev_from_world, np.array(origins)[:, :3])[:, :2]
        command = plan.command or followed(driven, plan.commands)
        path = apply(bev_from_world, plan.paths[plan.commands.index(command)])[:, :2]
        boxes = [frame.boxes.transformed(bev_from_world) for frame in later]
        frames.append(metrics.PlannedFrame(path, driven, boxes))
    if not frames:
        raise InputError(
            f"{file}: `plan` (`--plan`): no frame has a planned path and {max(times, default=3):g} s of ground truth"
        )
    notes = [f"{left_out} frames at the end of scenes have no whole driven path: left out"] if left_out else []
    if guessed:
        notes.append(f"{guessed} frames have no command: the path of the command that the driver followed is scored")
    return metrics.evaluate_plans(frames, float(times[0])), tuple(notes)


def followed(driven: Array, commands: Sequence[str]) -> str:
    """The command that a driven path (T, 2) follows, by its last place; the first command where that is unknown."""
    across = driven[-1, 0]
    command = "right" if across >= TURN_M else "left" if across <= -TURN_M else "straight"
    return command if command in commands else commands[0]
