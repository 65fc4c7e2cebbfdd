"""How wrong a prediction is that has found its ground truth: the five errors of nuScenes."""

from __future__ import annotations

import numpy as np

from bevcli.evaluation.config import ERRORS
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, wrap_angle


def true_positive_errors(class_name: str, truth: Boxes3D, found: Boxes3D) -> dict[str, Array]:
    """The errors of M matched pairs of one class, each (M,), by the devkit's names.

    trans_err: m, horizontally. scale_err: 1 - IoU of the sizes, place and heading aligned. orient_err: radians, a
    barrier's front and back are the same. vel_err: m/s, NaN where the truth is unknown. attr_err: 0 right,
    1 wrong, NaN where the truth has none.
    """
    offsets = found.centers[:, :2] - truth.centers[:, :2]
    common = np.minimum(truth.sizes_lwh, found.sizes_lwh).prod(axis=1)
    union = truth.sizes_lwh.prod(axis=1) + found.sizes_lwh.prod(axis=1) - common
    half_turns = 2 if class_name == "barrier" else 1
    turn = wrap_angle(half_turns * (truth.yaws - found.yaws)) / half_turns
    assert truth.attributes is not None
    assert found.attributes is not None
    wrong = (truth.attributes != found.attributes).astype(np.float64)
    errors = (
        np.hypot(offsets[:, 0], offsets[:, 1]),
        1 - common / union,
        np.abs(turn),
        np.linalg.norm(found.velocities - truth.velocities, axis=1),
        np.where(truth.attributes == "", np.nan, wrong),
    )
    return dict(zip(ERRORS, errors, strict=True))
