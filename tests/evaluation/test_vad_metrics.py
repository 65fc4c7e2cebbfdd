"""Metrics of lines, forecasts and planned paths equal those of the released code of VAD and UniAD."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.workshop.formats.map_lines import MapLines
from bevcli.workshop.vad.driving_metrics import (
    MIN_SCORE,
    PlannedFrame,
    PlanScores,
    _Curve,
    collisions,
    evaluate_lines,
    evaluate_motion,
    evaluate_plans,
    hits,
    match,
    occupancy,
    similarity,
)

VEHICLES = range(14, 24)
HUMANS = range(2, 9)


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, Any]:
    return json.loads((shared / "golden/golden_vad_metrics.json").read_text())


def lines_of(vectors: list[dict], classes: list[str]) -> MapLines:
    points = tuple(np.array(v["pts"], dtype=float) for v in vectors)
    scores = np.array([v.get("confidence_level", 0.0) for v in vectors])
    return MapLines(points, np.array([classes[v["type"]] for v in vectors], dtype=np.str_), scores)


@pytest.mark.parametrize("name", ["set_A", "set_B"])
def test_average_precision_of_lines_equals_vads(golden: dict[str, Any], name: str) -> None:
    of_map = golden["map"]
    truth, found = ([list(sample["vectors"]) for sample in of_map["set_A"][key]] for key in ("gt", "pred"))
    if name == "set_B":
        for vectors, added in zip(
            (*truth, *found), (*of_map[name]["gt_added"], *of_map[name]["pred_added"]), strict=True
        ):
            vectors += [] if added is None else [added]
    pairs = [tuple(lines_of(side, of_map["classes"]) for side in pair) for pair in zip(found, truth, strict=True)]
    scores, expected = evaluate_lines(pairs, of_map["classes"]), of_map[name]["result"]
    for limit, of_class in ((limit, expected[f"{limit}"]) for limit in of_map["thresholds"]):
        for kind in of_map["classes"]:
            assert scores.ap[kind][limit] == pytest.approx(of_class[kind]["ap"], abs=1e-6)
            assert scores.truth_count[kind] == of_class[kind]["num_gts"]
    assert scores.mean_by_class == pytest.approx(expected["class_ap_mean_over_thresholds"], abs=1e-6)
    assert scores.mean_ap == pytest.approx(expected["mAP"], abs=1e-6)


def test_similarities_of_lines_equal_vads(golden: dict[str, Any]) -> None:
    sample, expected = golden["map"]["set_A"], golden["map"]["set_A"]["result"]["score_matrix"]["divider"][0]
    found, true = (
        [_Curve(np.array(v["pts"], dtype=float)) for v in sample[key][0]["vectors"] if v["type"] == 0]
        for key in ("pred", "gt")
    )
    assert np.sort(similarity(found, true), axis=0) == pytest.approx(np.sort(expected, axis=0), abs=1e-6)


def boxes_of(side: dict[str, Any], offsets: np.ndarray) -> Boxes3D:
    """Boxes whose futures are sums of offsets (N, M, T, 2), NaN where these are."""
    rows = np.array(side["boxes"], dtype=float)
    places = rows[:, None, None, :2] + offsets.cumsum(2)
    seconds = np.broadcast_to(0.5 * np.arange(1, places.shape[2] + 1)[:, None], (*places.shape[:3], 1))
    return Boxes3D(
        rows[:, :3],
        rows[:, [4, 3, 5]],
        -rows[:, 6] - np.pi / 2,
        rows[:, 7:],
        np.array(list(NUSCENES_CLASSES))[side["labels"]],
        np.array(side["scores"]) if "scores" in side else None,
        futures=np.concatenate([seconds, places], axis=-1),
    )


def motion_pair(sample: dict[str, Any]) -> tuple[Boxes3D, Boxes3D]:
    true = np.array(sample["gt"]["fut_offsets"], dtype=float)
    true[np.array(sample["gt"]["fut_mask"]) == 0] = np.nan
    found = boxes_of(sample["pred"], np.array(sample["pred"]["trajs"], dtype=float))
    return found, boxes_of(sample["gt"], true[:, None])


def test_metrics_of_forecasts_equal_vads(golden: dict[str, Any]) -> None:
    of_motion = golden["motion"]
    pairs = [motion_pair(sample) for sample in of_motion["samples"]]
    for (found, truth), expected in zip(pairs, of_motion["per_sample"], strict=True):
        assert match(found.scored(MIN_SCORE), truth).tolist() == expected["matched_prediction_of_each_gt"]
    scores = evaluate_motion(pairs)
    for key, value in of_motion["final"].items():
        metric, _, kind = key.partition("_")
        assert scores[kind].metrics[metric] == pytest.approx(value, abs=1e-6), key


def planned(sample: dict[str, Any]) -> PlannedFrame:
    """Agents of the released code are humans and vehicles by nuScenes' category; the others become barriers."""
    rows, moves = np.array(sample["boxes"]), np.array(sample["fut_offsets"], dtype=float).cumsum(1)
    turns, known = np.array(sample["fut_yaw_steps"], dtype=float).cumsum(1), np.array(sample["fut_mask"]) > 0
    kinds = ["car" if c in VEHICLES else "pedestrian" if c in HUMANS else "barrier" for c in sample["category_index"]]
    steps = []
    for step in range(moves.shape[1]):
        centers = rows[:, :3] + np.pad(moves[:, step], ((0, 0), (0, 1)))
        yaws = -(rows[:, 6] + np.pi / 2) + turns[:, step]
        boxes = Boxes3D(centers, rows[:, [4, 3, 5]], yaws, np.zeros((len(rows), 2)), np.array(kinds))
        steps.append(boxes[known[:, step]])
    path = np.array(sample["ego_pred_offsets"], dtype=float)[sample["command_index"]].cumsum(0)
    return PlannedFrame(path, np.array(sample["ego_gt_offsets"], dtype=float).cumsum(0), steps)


def test_steps_of_planned_paths_equal_vads(golden: dict[str, Any]) -> None:
    for sample, expected in zip(golden["planning"]["samples"], golden["planning"]["per_sample"], strict=True):
        frame = planned(sample)
        covered = occupancy([boxes[boxes.classes != "barrier"] for boxes in frame.others])
        runs = np.zeros_like(covered)
        for step, row, first, last in expected["occupied"]:
            runs[step, row, first : last + 1] = True
        assert np.array_equal(covered, runs)
        assert hits(frame.driven, covered).tolist() == [bool(x) for x in expected["gt_box_hits"]]
        assert hits(frame.path, covered).tolist() == [bool(x) for x in expected["pred_box_hits"]]
        found = collisions(frame.path, frame.driven, covered)
        assert found.tolist() == [bool(x) for x in expected["box_collision_per_step"]]


def plan_scores(golden: dict[str, Any]) -> PlanScores:
    valid = [sample for sample in golden["planning"]["samples"] if sample["fut_valid_flag"]]
    return evaluate_plans(map(planned, valid), 0.5)


def test_planned_paths_in_vads_convention_equal_vads(golden: dict[str, Any]) -> None:
    scores, expected = plan_scores(golden), golden["planning"]["vad_mean_over_valid_samples"]
    for seconds in (1, 2, 3):
        l2 = scores.averaged(scores.distances_m, seconds)
        assert l2 == pytest.approx(expected[f"plan_L2_{seconds}s"], abs=1e-6)
        rate = scores.averaged(scores.collisions, seconds)
        assert rate == pytest.approx(expected[f"plan_obj_box_col_{seconds}s"], abs=1e-6)


def test_planned_paths_in_uniads_convention_equal_uniads(golden: dict[str, Any]) -> None:
    scores, expected = plan_scores(golden), golden["planning"]["uniad_mean_per_step_over_valid_samples"]
    for step in range(6):
        assert scores.at(scores.distances_m, 0.5 * (step + 1)) == pytest.approx(expected["L2"][step], abs=1e-6)
        # These reference numbers are for vehicles and humans together.
        assert scores.at(scores.collisions, 0.5 * (step + 1)) == pytest.approx(expected["obj_box_col"][step], abs=1e-6)
