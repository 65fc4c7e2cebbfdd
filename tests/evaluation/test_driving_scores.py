"""`bevcli eval --map --motion --plan` on a drive of known motion: 4 m/s ahead, a car 20 m ahead at 2 m/s.

Metrics of lines, forecasts and planned paths equal those of the released code of VAD and UniAD.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import invoked

from bevcli.errors import InputError
from bevcli.frame import FrameStamp, Ground
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Pose, apply, rigid
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.workshop.formats.map_lines import LinesWriter, MapLines
from bevcli.workshop.scores.evaluate import evaluate
from bevcli.workshop.vad.driving_metrics import (
    MIN_SCORE,
    PlannedFrame,
    evaluate_lines,
    evaluate_motion,
    evaluate_plans,
    match,
)
from bevcli.workshop.vad.plan import Plan, PlanWriter

FRAMES, TIMES = 10, 0.5 * np.arange(1, 7)
OWN_MPS, CAR_MPS = 4.0, 2.0
LINE = np.array([[-2.0, -20.0], [-2.0, 20.0]])  # bev frame


def pose(frame: int) -> Pose:
    return Pose.from_matrix(rigid([100 + 0.5 * OWN_MPS * frame, 50, 0]))


def car(frame: int, name: str = "car") -> Boxes3D:
    """In the world frame, with its future."""
    x = 120 + 0.5 * CAR_MPS * frame
    future = np.stack([TIMES, x + CAR_MPS * TIMES, np.full(6, 50.0)], axis=-1)
    return Boxes3D(
        np.array([[x, 50, 0.8]]), np.array([[4.0, 2, 1.6]]), np.zeros(1), np.array([[CAR_MPS, 0]]), np.array([name]),
        scores=np.ones(1), instances=np.array(["7"]), futures=future[None, None],
    )  # fmt: skip


def path(mps: float) -> Plan:
    """Straight ahead, in the bev frame: x right, y ahead. The path to the left leaves the road."""
    ahead = np.stack([np.zeros(6), mps * TIMES], axis=-1)
    return Plan(("left", "straight"), np.stack([ahead - (9, 0), ahead]), TIMES, "straight")


def write(folder: Path, boxes: Callable[[int], Boxes3D], plan: Plan, line: np.ndarray, names: tuple[str, str]) -> Path:
    """The files of predictions or of ground truth. names: of boxes and of lines."""
    folder.mkdir()
    lines = LinesWriter(folder / names[1], "world", {"classes": ["divider"]})
    plans = PlanWriter(folder / "plan.csv", "world", {})
    with BoxesWriter(folder / names[0], "world", {"x_range_m": [-15, 15], "y_range_m": [-30, 30]}) as writer:
        for frame in range(FRAMES):
            stamp = FrameStamp(frame, "s", 500_000_000 * frame)
            ground = Ground(stamp, default_ego_from_bev(), pose(frame))
            writer.write(FrameBoxes(stamp, pose(frame), boxes(frame)))
            lines.write(ground, MapLines((line,), np.array(["divider"]), np.ones(1)))
            plans.write(ground, plan)
    lines.close()
    plans.close()
    return folder


def scored(
    tmp_path: Path, *, boxes: Callable[[int], Boxes3D] = car, plan: Plan, line: np.ndarray = LINE
) -> dict[str, Any]:
    found = write(tmp_path / "found", boxes, plan, line, ("predictions.json", "map_lines.json"))
    truth = write(tmp_path / "truth", car, plan, LINE, ("ground_truth.json", "ground_truth_lines.json"))
    return json.loads(invoked("eval", found, truth, "--map", "--motion", "--plan", "--json").stdout)


def test_perfect_predictions_have_perfect_scores(tmp_path: Path) -> None:
    scores = scored(tmp_path, plan=path(OWN_MPS))
    assert scores["map"]["mean_ap"] == 1
    assert scores["motion"]["car"] == pytest.approx(
        {"EPA": 1, "minADE": 0, "minFDE": 0, "MR": 0, "ground_truth": 4}, abs=2e-3
    )
    assert scores["motion"]["pedestrian"]["EPA"] is None
    assert scores["plan"]["frames"] == 4
    for convention in ("averaged_up_to_horizon", "at_horizon"):
        assert scores["plan"][convention]["L2"] == pytest.approx({"1s": 0, "2s": 0, "3s": 0}, abs=2e-3)
        assert scores["plan"][convention]["collision"] == {"1s": 0, "2s": 0, "3s": 0}


def test_errors_are_those_of_the_predictions(tmp_path: Path) -> None:
    def slow(frame: int) -> Boxes3D:
        found = car(frame)
        assert found.futures is not None
        found.futures[..., 1] -= TIMES  # 1 m/s too slow
        return found

    scores = scored(tmp_path, boxes=slow, plan=path(OWN_MPS + 3), line=LINE + (0.7, 0))
    assert scores["map"]["label_aps"]["divider"] == {"0.5": 0, "1.0": 1, "1.5": 1}
    # 1.75 in the four frames with all six steps, then 1.5, 1.25, 1, 0.75 and 0.5 over the steps that are known.
    assert scores["motion"]["car"]["minADE"] == pytest.approx(12 / 9, abs=2e-3)
    assert scores["motion"]["car"]["minFDE"] == pytest.approx(3, abs=2e-3)
    assert scores["motion"]["car"]["MR"] == 1
    plan = scores["plan"]
    assert plan["at_horizon"]["L2"] == pytest.approx({"1s": 3, "2s": 6, "3s": 9}, abs=2e-3)
    # The mean of 1.5, 3, 4.5 and so on; the planned vehicle drives into the car, the true one does not.
    assert plan["averaged_up_to_horizon"]["L2"] == pytest.approx({"1s": 2.25, "2s": 3.75, "3s": 5.25}, abs=2e-3)
    assert plan["at_horizon"]["collision"]["1s"] == 0
    assert plan["at_horizon"]["collision"]["3s"] == 1


def test_objects_of_frames_without_predictions_are_not_found(tmp_path: Path) -> None:
    found = write(tmp_path / "found", car, path(1.0), LINE, ("predictions.json", "map_lines.json"))
    truth = write(tmp_path / "truth", car, path(1.0), LINE, ("ground_truth.json", "ground_truth_lines.json"))
    content = json.loads((found / "predictions.json").read_text())
    del content["frames"][0]
    (found / "predictions.json").write_text(json.dumps(content))
    scores = evaluate(found, truth, count_missing=True, motion=True).vad.motion
    assert scores is not None
    assert (scores["car"].truths, scores["car"].hits) == (4, 3)


def test_missing_files_are_named(tmp_path: Path) -> None:
    found = write(tmp_path / "found", car, path(1.0), LINE, ("predictions.json", "map_lines.json"))
    truth = write(tmp_path / "truth", car, path(1.0), LINE, ("ground_truth.json", "other.json"))
    with pytest.raises(InputError, match=r"ground_truth_lines\.json: `map` \(`--map`\): the file is missing"):
        evaluate(found, truth, map=True)


def test_a_line_may_be_reversed_and_cut_otherwise() -> None:
    found = MapLines((np.array([[0.0, 9.0], [0.0, 4.0], [0.0, 0.0]]),), np.array(["divider"]), np.ones(1))
    true = MapLines((np.array([[0.2, 0.0], [0.2, 9.0]]),), np.array(["divider"]))
    scores = evaluate_lines([(found, true)], ["divider", "boundary"])
    assert scores.ap["divider"] == {0.5: 1, 1.0: 1, 1.5: 1}
    assert scores.mean_ap == 0.5  # without true boundaries, their AP is 0


def test_pedestrians_are_left_out_at_the_horizon() -> None:
    way = np.zeros((2, 2))
    on_path = apply(rigid([0.0, 10.0, 0.0]), np.zeros((1, 3)))
    person = Boxes3D(on_path, np.ones((1, 3)), np.zeros(1), np.zeros((1, 2)), np.array(["pedestrian"]))
    frame = PlannedFrame(way + (0, 10), way, [person, person])
    scores = evaluate_plans([frame], step_s=0.5)
    assert scores.averaged(scores.collisions, 1) == 1
    assert scores.at(scores.collisions_with_vehicles, 1) == 0


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


def test_planned_paths_equal_those_of_vad_and_uniad(golden: dict[str, Any]) -> None:
    of_plans = golden["planning"]
    scores = evaluate_plans([planned(sample) for sample in of_plans["samples"] if sample["fut_valid_flag"]], 0.5)
    for seconds in (1, 2, 3):
        expected = [
            of_plans["vad_mean_over_valid_samples"][f"plan_{name}_{seconds}s"] for name in ("L2", "obj_box_col")
        ]
        found = [scores.averaged(values, seconds) for values in (scores.distances_m, scores.collisions)]
        assert found == pytest.approx(expected, abs=1e-6)
    # UniAD's reference numbers are for vehicles and humans together.
    uniad, seconds = of_plans["uniad_mean_per_step_over_valid_samples"], [0.5 * (step + 1) for step in range(6)]
    assert [scores.at(scores.distances_m, s) for s in seconds] == pytest.approx(uniad["L2"][:6], abs=1e-6)
    assert [scores.at(scores.collisions, s) for s in seconds] == pytest.approx(uniad["obj_box_col"][:6], abs=1e-6)
