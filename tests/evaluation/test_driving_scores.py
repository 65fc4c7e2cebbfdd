"""`bevcli eval --map --motion --plan` on a drive of known motion: 4 m/s ahead, a car 20 m ahead at 2 m/s."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from bevcli.cli.main import app
from bevcli.errors import InputError
from bevcli.frame import FrameStamp, Ground
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.transforms import Pose, apply, rigid
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.workshop.formats.map_lines import LinesWriter, MapLines
from bevcli.workshop.scores.evaluate import evaluate
from bevcli.workshop.vad.driving_metrics import PlannedFrame, evaluate_lines, evaluate_plans
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
    options = ["--map", "--motion", "--plan", "--json"]
    result = CliRunner().invoke(app, ["eval", str(found), str(truth), *options], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


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
