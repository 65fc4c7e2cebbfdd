"""The scores are those of the nuScenes devkit, on boxes that its own numbers are known for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.detection import evaluate
from bevcli.geometry.boxes import Boxes3D


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


def test_every_number_equals_the_devkits(shared: Path) -> None:
    golden = json.loads((shared / "golden" / "detection_metrics.json").read_text())
    samples = list(dict.fromkeys(row["sample"] for row in golden["predictions"]))
    predictions, ground_truth = (
        [boxes([row for row in golden[key] if row["sample"] == sample]) for sample in samples]
        for key in ("predictions", "ground_truth")
    )
    # The numbers were computed without ego poses, so that no class range was applied (two predictions lie beyond).
    scores = evaluate(predictions, ground_truth, DetectionConfig().unlimited())
    expected = golden["expected"]
    for name, found in scores.overall.classes.items():
        for distance, ap in found.aps.items():
            assert ap == pytest.approx(expected["label_aps"][name][f"{distance:.1f}"], abs=1e-9), (name, distance)
        for error, value in found.errors.items():
            number = expected["label_tp_errors"][name][error]
            assert value == pytest.approx(np.nan if number is None else number, abs=1e-9, nan_ok=True), (name, error)
        assert found.mean_ap == pytest.approx(expected["mean_dist_aps"][name], abs=1e-9)
    assert scores.overall.mean_ap == pytest.approx(expected["mean_ap"], abs=1e-9)
    assert scores.overall.nd_score == pytest.approx(expected["nd_score"], abs=1e-9)
    assert scores.overall.errors == pytest.approx(expected["tp_errors"], abs=1e-9)
    assert scores.overall.error_scores == pytest.approx(expected["tp_scores"], abs=1e-9)
