"""TrackingConfig: how tracks are scored, nuScenes' `tracking_nips_2019`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from bevcli.errors import ConfigError

# The seven tracking classes, with the distance from the ego vehicle up to which each is scored, in metres.
TRACKING_RANGES_M = {
    "bicycle": 40.0, "bus": 50.0, "car": 50.0, "motorcycle": 40.0, "pedestrian": 40.0, "trailer": 50.0, "truck": 50.0,
}  # fmt: skip
TRACKING_CLASSES = tuple(TRACKING_RANGES_M)


@dataclass(frozen=True)
class TrackingConfig:
    """All parameters of the tracking metrics; the defaults are the nuScenes devkit's.

    Attributes:
        class_ranges_m: class -> horizontal distance from the ego vehicle below which its boxes are scored.
        match_distance_m: centres that are closer on the ground can match.
        recall_levels: number of recall levels from `min_recall` to 1 over which AMOTA and AMOTP are means.
        min_recall: the lowest recall level.
        frame_period_s: duration that one frame counts in tid and lgd, whatever the timestamps are.
        mostly_tracked, mostly_lost: an object counts as mostly tracked when it is matched in at least, and as mostly
            lost when it is matched in less than, this share of its frames.
    """

    class_ranges_m: Mapping[str, float] = field(default_factory=lambda: dict(TRACKING_RANGES_M))
    match_distance_m: float = 2.0
    recall_levels: int = 40
    min_recall: float = 0.1
    frame_period_s: float = 0.5
    mostly_tracked: float = 0.8
    mostly_lost: float = 0.2

    def cut_at(self, max_range_m: float) -> TrackingConfig:
        """The same parameters with every class range cut at a distance in metres. Raises ConfigError."""
        if not max_range_m > 0:
            raise ConfigError(f"the largest range must be above 0 m, found {max_range_m:g}")
        return replace(self, class_ranges_m={name: min(m, max_range_m) for name, m in self.class_ranges_m.items()})

    def unlimited(self) -> TrackingConfig:
        """The same parameters without class ranges, for boxes whose ego pose is unknown."""
        return replace(self, class_ranges_m=dict.fromkeys(self.class_ranges_m, math.inf))
