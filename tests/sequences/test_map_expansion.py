"""Lines of nuScenes' map expansion around a vehicle, and the scores that need them.

The vehicle is at world (0, 2000.5) and drives along x; its lidar is 1 m ahead, so that bev x is 2000.5 - y and
bev y is x - 1.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nuscenes_tables import Size, token, write_tables
from typer.testing import CliRunner

from bevcli.cli.main import app
from bevcli.errors import InputError
from bevcli.frame import Ground
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.sequences.files.json_fields import pose_to_json
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.map_lines import LinesWriter, MapLines
from bevcli.workshop.scores.evaluate import evaluate
from bevcli.workshop.vad.plan import Plan, PlanWriter

TIMES = 0.5 * np.arange(1, 7)


class Expansion:
    """Builds the JSON of a map."""

    def __init__(self) -> None:
        self.tables = {name: [] for name in ("node", "line", "polygon", "lane_divider", "road_divider", "ped_crossing",
                                             "road_segment", "lane")}  # fmt: skip

    def _nodes(self, points: list[tuple[float, float]]) -> list[str]:
        first = len(self.tables["node"])
        self.tables["node"] += [{"token": f"n{first + k}", "x": x, "y": y} for k, (x, y) in enumerate(points)]
        return [f"n{first + k}" for k in range(len(points))]

    def line(self, kind: str, points: list[tuple[float, float]]) -> None:
        own = f"{kind}{len(self.tables['line'])}"
        self.tables["line"].append({"token": own, "node_tokens": self._nodes(points)})
        self.tables[kind].append({"line_token": own})

    def rectangle(self, kind: str, x: tuple[float, float], y: tuple[float, float], hole: tuple = ()) -> None:
        own = f"{kind}{len(self.tables['polygon'])}"
        rings = [[(a, y[0]), (b, y[0]), (b, y[1]), (a, y[1])] for (a, b), y in ((x, y), *hole)]
        outer, *holes = map(self._nodes, rings)
        row = {"token": own, "exterior_node_tokens": outer, "holes": [{"node_tokens": one} for one in holes]}
        self.tables["polygon"].append(row)
        self.tables[kind].append({"polygon_token": own})


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A road of two pieces, with an island in one, a divider, and a crossing of two halves."""
    root = tmp_path_factory.mktemp("nuscenes")
    write_tables(root / "v1.0-mini", Size(scenes=1, samples=8, objects=2))
    (root / "v1.0-mini" / "log.json").write_text(json.dumps([{"token": token(9, 0), "location": "here"}]))
    made = Expansion()
    made.rectangle("road_segment", (-100, 0), (1996, 2005))
    made.rectangle("lane", (0, 200), (1996, 2005), hole=(((20, 22), (2002, 2003)),))
    made.rectangle("ped_crossing", (10, 13), (1996, 2000))
    made.rectangle("ped_crossing", (10, 13), (2000, 2005))
    made.line("lane_divider", [(-100, 2000.5), (200, 2000.5)])
    made.line("road_divider", [(5000, 2000), (5100, 2000)])
    (root / "maps" / "expansion").mkdir(parents=True)
    (root / "maps" / "expansion" / "here.json").write_text(json.dumps(made.tables))
    return root


def extents(lines: MapLines, name: str) -> set[tuple[float, ...]]:
    """Left, right, rear and front end of each line of a class, bev frame."""
    chosen = [points for points, own in zip(lines.points, lines.classes, strict=True) if own == name]
    return {tuple(np.stack([p.min(0), p.max(0)], axis=1).ravel().round(6)) for p in chosen}


def test_lines_are_cut_and_in_the_bev_frame(root: Path) -> None:
    (lines,) = open_sequence(root).ground_truth_frame(0).ground_truth_results
    assert extents(lines, "divider") == {(0, 0, -30, 30)}
    assert extents(lines, "ped_crossing") == {(-4.5, 4.5, 9, 12)}  # its halves are one
    assert extents(lines, "boundary") == {(4.5, 4.5, -30, 30), (-4.5, -4.5, -30, 30), (-2.5, -1.5, 19, 21)}


def perfect_run(root: Path, folder: Path) -> Path:
    """What a model would predict that knows everything: objects move along y at 2 m/s, the vehicle at 5 m/s."""
    folder.mkdir()
    drive = open_sequence(root)
    lines = LinesWriter(folder / "map_lines.json", "world", {"classes": ["divider", "ped_crossing", "boundary"]})
    plans = PlanWriter(folder / "plan.csv", "world", {})
    plan = Plan(("straight",), np.stack([np.zeros(6), 5 * TIMES], axis=-1)[None], TIMES, "straight")
    with BoxesWriter(folder / "predictions.json", "world", {}) as writer:
        for place in range(len(drive.stamps)):
            frame = drive.ground_truth_frame(place)
            ground, boxes = Ground(frame.stamp, frame.rig.ego_from_bev, frame.world_from_ego), frame.ground_truth
            x, y = boxes.centers[:, :1] + 0 * TIMES, boxes.centers[:, 1:2] + 2 * TIMES
            futures = np.stack([np.broadcast_to(TIMES, x.shape), x, y], axis=-1)[:, None]
            scored = boxes.__class__(**vars(boxes) | {"scores": np.ones(len(boxes)), "futures": futures})
            stated = {"ego_from_bev": pose_to_json(Pose.from_matrix(frame.rig.ego_from_bev))}
            writer.write(FrameBoxes(frame.stamp, frame.world_from_ego, scored, stated))
            scores = [replace(true, scores=np.ones(len(true))) for true in frame.ground_truth_results]
            lines.write(ground, scores[0] if scores else None)
            plans.write(ground, plan)
    lines.close()
    plans.close()
    return folder


def test_a_root_is_ground_truth_of_lines_futures_and_plans(root: Path, tmp_path: Path) -> None:
    run = perfect_run(root, tmp_path / "run")
    options = ["--map", "--motion", "--plan", "--json"]
    result = CliRunner().invoke(app, ["eval", str(run), str(root), *options], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    scores = json.loads(result.stdout)
    assert scores["map"]["mean_ap"] == 1
    assert scores["map"]["ground_truth_lines"]["divider"] == 8
    assert scores["motion"]["car"]["minADE"] == pytest.approx(0, abs=2e-3)
    assert scores["motion"]["car"]["EPA"] == 1
    assert scores["plan"]["frames"] == 2
    assert scores["plan"]["at_horizon"]["L2"]["3s"] == pytest.approx(0, abs=2e-3)


def test_missing_or_wrong_maps_are_named(root: Path, tmp_path: Path) -> None:
    run, bare = perfect_run(root, tmp_path / "run"), tmp_path / "bare"
    write_tables(bare / "v1.0-mini", Size(scenes=1, samples=8, objects=2))
    with pytest.raises(InputError, match=r"scene-0001.* has no true lines .*the map expansion in .*/expansion"):
        evaluate(run, bare, map=True)
    (bare / "v1.0-mini" / "log.json").write_text(json.dumps([{"token": token(9, 0), "location": "here"}]))
    (bare / "maps" / "expansion").mkdir(parents=True)
    (bare / "maps" / "expansion" / "here.json").write_text('{"node": [{"token": "a"}]}')
    with pytest.raises(InputError, match=r"here\.json: KeyError\('x'\) \(expected a map of nuScenes' map expansion"):
        open_sequence(bare).ground_truth_frame(0)
