"""How detections are scored: nuScenes' detection_cvpr_2019, and what we add to it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from bevcli.errors import ConfigError
from bevcli.geometry.boxes import CLASSES

# How far from the ego vehicle a class is scored, in metres (detection_cvpr_2019).
CLASS_RANGES_M = {
    "car": 50.0, "truck": 50.0, "construction_vehicle": 50.0, "bus": 50.0, "trailer": 50.0,
    "barrier": 30.0, "motorcycle": 40.0, "bicycle": 40.0, "pedestrian": 40.0, "traffic_cone": 30.0,
}  # fmt: skip
assert set(CLASS_RANGES_M) == set(CLASSES)

# The devkit's names of the five errors: m, 1 - IoU, radians, m/s, 1 - accuracy.
ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
# Errors that mean nothing for a class: a cone has no heading, and neither moves.
MEANINGLESS_ERRORS = {
    "traffic_cone": ("orient_err", "vel_err", "attr_err"),
    "barrier": ("vel_err", "attr_err"),
}


@dataclass(frozen=True)
class DetectionConfig:
    """All choices of the score; the defaults are the devkit's.

    class_ranges_m: horizontal distance from the ego vehicle below which a class is scored. distances_m: centres
    closer than this match, one AP each. error_distance_m: the one at which errors and recall are measured.
    min_recall, min_precision: what lies below counts as noise. mean_ap_weight: of mAP in NDS; each error weighs 1.
    range_bins_m, visibility_bins: for the additional tables; a bin holds its lower end (and 1, the last one).
    """

    class_ranges_m: Mapping[str, float] = field(default_factory=lambda: dict(CLASS_RANGES_M))
    distances_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    error_distance_m: float = 2.0
    min_recall: float = 0.1
    min_precision: float = 0.1
    mean_ap_weight: float = 5.0
    range_bins_m: tuple[tuple[float, float], ...] = ((0, 10), (10, 20), (20, 30), (30, 40), (40, 50))
    visibility_bins: tuple[tuple[float, float], ...] = ((0.0, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.0))

    def cut_at(self, max_range_m: float) -> DetectionConfig:
        """The same score, of nothing farther away than this. Raises ConfigError for a distance that is none."""
        if not max_range_m > 0:
            raise ConfigError(f"the largest range must be above 0 m, found {max_range_m:g}")
        cut = {name: min(limit, max_range_m) for name, limit in self.class_ranges_m.items()}
        bins = tuple((low, min(high, max_range_m)) for low, high in self.range_bins_m if low < max_range_m)
        return replace(self, class_ranges_m=cut, range_bins_m=bins)

    def unlimited(self) -> DetectionConfig:
        """The same score at any distance: what the devkit computes for boxes whose ego pose it was not told."""
        return replace(self, class_ranges_m=dict.fromkeys(self.class_ranges_m, math.inf))
