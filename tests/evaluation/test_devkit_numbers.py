"""The scores equal those of the nuScenes devkit.

tests/data/detection_metrics.json holds synthetic boxes and the scores that devkit 1.2.0 computed for them with the
configuration detection_cvpr_2019.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.matching import DetectionConfig
from bevcli.workshop.scores.detection import evaluate_detections
from bevcli.workshop.scores.evaluate import evaluate

GOLDEN = json.loads((Path(__file__).parents[1] / "data" / "detection_metrics.json").read_text())
TOLERANCE = 1e-9  # docs/scoring.md and README.md state it


def boxes(rows: list[dict[str, Any]]) -> Boxes3D:
    def column(key: str) -> Any:
        return np.array([row[key] for row in rows])

    return Boxes3D(
        centers=column("center").reshape(-1, 3),
        sizes_lwh=column("size_lwh").reshape(-1, 3),
        yaws=column("yaw"),
        velocities=column("velocity").reshape(-1, 2),
        classes=column("class"),
        scores=column("score"),
        attributes=column("attribute"),
    )


def test_every_number_equals_the_devkits() -> None:
    samples = list(dict.fromkeys(row["sample"] for row in GOLDEN["predictions"]))
    predictions, ground_truth = (
        [boxes([row for row in GOLDEN[key] if row["sample"] == sample]) for sample in samples]
        for key in ("predictions", "ground_truth")
    )
    # The devkit's boxes had no ego poses, so it applied no class ranges (two predictions are outside).
    scores = evaluate_detections(predictions, ground_truth, DetectionConfig().unlimited())
    expected = GOLDEN["expected"]
    for name, found in scores.overall.classes.items():
        for distance, ap in found.aps.items():
            assert ap == pytest.approx(expected["label_aps"][name][f"{distance:.1f}"], abs=TOLERANCE), (name, distance)
        for error, value in found.errors.items():
            number = expected["label_tp_errors"][name][error]
            assert value == pytest.approx(np.nan if number is None else number, abs=TOLERANCE, nan_ok=True), (
                name,
                error,
            )
        assert found.mean_ap == pytest.approx(expected["mean_dist_aps"][name], abs=TOLERANCE)
    assert scores.overall.mean_ap == pytest.approx(expected["mean_ap"], abs=TOLERANCE)
    assert scores.overall.nd_score == pytest.approx(expected["nd_score"], abs=TOLERANCE)
    assert scores.overall.errors == pytest.approx(expected["tp_errors"], abs=TOLERANCE)
    assert scores.overall.error_scores == pytest.approx(expected["tp_scores"], abs=TOLERANCE)


def test_every_number_of_evaluated_files_equals_the_devkits(tmp_path: Path) -> None:
    for side in ("predictions", "ground_truth"):
        frames: list[dict[str, Any]] = [
            {"frame": place, "timestamp_ns": place * 500_000_000, "boxes": []} for place in range(12)
        ]
        for row in GOLDEN[side]:
            kept = {key: value for key, value in row.items() if key != "sample" and value != -1.0}
            frames[int(row["sample"].removeprefix("sample-"))]["boxes"].append(kept)
        content = {"format": "bevcli-boxes/1", "frame_of_reference": "ego", "frames": frames}
        (tmp_path / f"{side}.json").write_text(json.dumps(content))
    scores = evaluate(tmp_path / "predictions.json", tmp_path / "ground_truth.json").to_dict()
    for key, expected in GOLDEN["expected"].items():
        if isinstance(expected, float):
            assert scores[key] == pytest.approx(expected, abs=TOLERANCE)
        else:
            for name, value in expected.items():
                assert scores[key][name] == pytest.approx(value, abs=TOLERANCE, nan_ok=True), (key, name)
