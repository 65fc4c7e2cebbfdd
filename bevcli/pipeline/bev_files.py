"""BEV features as files: one float16 .npy per frame, and a JSON file that describes it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bevcli.errors import OutputError
from bevcli.frame import Prediction
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.transform_json import pose_to_json


def save_bev(folder: Path, prediction: Prediction, extras: Mapping[str, object]) -> None:
    """Writes NNNNNN.npy, (rows, columns, C) float16, and NNNNNN.json with grid, ranges, frame and poses.

    Rows run from the smallest y, columns from the smallest x, both in the bev frame.

    Args:
        folder: where to write; made if missing.
        prediction: of a frame with at least one image.
        extras: further entries of the JSON file.

    Raises:
        OutputError: the files cannot be written.
    """
    assert prediction.bev is not None
    grid = prediction.grid
    features = prediction.bev.float().cpu().numpy().reshape(grid.rows, grid.columns, -1).astype(np.float16)
    facts = {
        "format": "bevcli-bev/1",
        "frame": prediction.stamp.index,
        "scene": prediction.stamp.scene,
        "timestamp_ns": prediction.stamp.timestamp_ns,
        "shape": list(features.shape),
        "axes": "rows from the smallest y, columns from the smallest x, channels; bev frame",
        "x_range_m": list(grid.x_range_m),
        "y_range_m": list(grid.y_range_m),
        "ego_from_bev": pose_to_json(Pose.from_matrix(prediction.ego_from_bev)),
        "world_from_ego": pose_to_json(prediction.world_from_ego),
        **extras,
    }
    name = f"{prediction.stamp.index:06d}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"{name}.npy", features)
        (folder / f"{name}.json").write_text(json.dumps(facts, indent=1) + "\n")
    except OSError as error:
        raise OutputError(f"{folder}: BEV features cannot be written ({error.strerror})") from None
