"""results_nusc.json: predictions in the form of a nuScenes detection submission."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.sequences.files.incremental_json import IncrementalJson

MOST_BOXES = 500  # a sample, by the rules of the benchmark; the best by score are kept
META = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}


class SubmissionWriter:
    """`with SubmissionWriter(path) as writer: writer.write(frame)`; the file is whole after every frame.

    Raises OutputError where the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file = IncrementalJson(path, json.dumps({"meta": META})[:-1] + ', "results": {', "}}")

    def write(self, frame: FrameBoxes) -> None:
        """Add a frame with its boxes in the world. A frame without a sample token (no keyframe) is left out."""
        token = frame.extras.get("sample_token")
        if token is not None:
            self._file.append(submission_boxes(frame.boxes, token), f"frame {frame.stamp.index}", key=token)

    def __enter__(self) -> SubmissionWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def submission_boxes(boxes: Boxes3D, sample_token: str) -> list[dict[str, Any]]:
    """Boxes in the world, with scores, as a submission's objects: the best 500, best first.

    Where boxes have no attributes, these follow from class and speed. An unknown velocity is given as 0.
    """
    assert boxes.scores is not None or not len(boxes)
    best = boxes if boxes.scores is None else boxes[np.argsort(-boxes.scores, kind="stable")[:MOST_BOXES]]
    attributes = attributes_by_speed(best) if best.attributes is None else best.attributes
    scores = np.zeros(0) if best.scores is None else best.scores
    half_yaws = best.yaws / 2
    rows = zip(
        best.centers.tolist(),
        best.sizes_lwh[:, [1, 0, 2]].tolist(),
        np.cos(half_yaws).tolist(),
        np.sin(half_yaws).tolist(),
        np.nan_to_num(best.velocities, nan=0.0).tolist(),
        best.classes.tolist(),
        scores.tolist(),
        attributes.tolist(),
        strict=True,
    )
    return [
        {
            "sample_token": sample_token,
            "translation": center,
            "size": size_wlh,
            "rotation": [w, 0.0, 0.0, z],
            "velocity": velocity,
            "detection_name": name,
            "detection_score": score,
            "attribute_name": attribute,
        }
        for center, size_wlh, w, z, velocity, name, score, attribute in rows
    ]


def write_submission(boxes: BoxesFile, path: Path) -> None:
    """Write a whole file of predictions. Raises InputError where they are not of nuScenes, or not in the world."""
    if boxes.frame_of_reference != "world":
        raise InputError(
            f"a nuScenes submission needs boxes in the world, but these are in the {boxes.frame_of_reference} frame: "
            "run with ego-motion"
        )
    if not any("sample_token" in frame.extras for frame in boxes.frames):
        raise InputError('a nuScenes submission needs a "sample_token" in every frame: run on a nuScenes root')
    with SubmissionWriter(path) as writer:
        for frame in boxes.frames:
            writer.write(frame)
