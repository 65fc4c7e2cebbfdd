"""Parameters of the detection score: nuScenes' detection_cvpr_2019, and bins for additional tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from bevcli.errors import ConfigError
from bevcli.geometry.boxes import CLASSES

# Distance from the ego vehicle up to which a class is scored, metres (detection_cvpr_2019).
CLASS_RANGES_M = {
    "car": 50.0, "truck": 50.0, "construction_vehicle": 50.0, "bus": 50.0, "trailer": 50.0,
    "barrier": 30.0, "motorcycle": 40.0, "bicycle": 40.0, "pedestrian": 40.0, "traffic_cone": 30.0,
}  # fmt: skip
assert set(CLASS_RANGES_M) == set(CLASSES)

# The devkit's names of the five true-positive errors, in m, 1 - IoU, radians, m/s, 1 - accuracy.
ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
# Errors that are not defined for a class: a cone has no heading, and both never move.
UNDEFINED_ERRORS = {
    "traffic_cone": ("orient_err", "vel_err", "attr_err"),
    "barrier": ("vel_err", "attr_err"),
}


@dataclass(frozen=True)
class DetectionConfig:
    """Parameters of the detection score; the defaults are the devkit's.

    Attributes:
        class_ranges_m: by class, the distance from the ego vehicle on the ground below which it is scored, metres.
        distances_m: matching distances of the centres on the ground, metres; one AP each.
        error_distance_m: the matching distance for true-positive errors and recall, metres.
        min_recall: precision at lower recall is ignored, 0 to 1.
        min_precision: lower precision counts as 0, 0 to 1.
        mean_ap_weight: weight of mAP in NDS; each error has weight 1.
        range_bins_m: rings around the ego vehicle for the table by range, lower end included, metres.
        visibility_bins: for the table by visibility, lower end included; the last bin includes 1.
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
        """The same score with all class ranges cut at max_range_m. Raises ConfigError if it is not positive."""
        if not max_range_m > 0:
            raise ConfigError(f"the largest range is not positive (expected more than 0 m, found {max_range_m:g})")
        cut = {name: min(limit, max_range_m) for name, limit in self.class_ranges_m.items()}
        bins = tuple((low, min(high, max_range_m)) for low, high in self.range_bins_m if low < max_range_m)
        return replace(self, class_ranges_m=cut, range_bins_m=bins)

    def unlimited(self) -> DetectionConfig:
        """The same score without class ranges: what the devkit computes for boxes without an ego pose."""
        return replace(self, class_ranges_m=dict.fromkeys(self.class_ranges_m, math.inf))
