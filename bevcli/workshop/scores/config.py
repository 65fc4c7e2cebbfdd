"""Parameters of the detection score (nuScenes' detection_cvpr_2019), and the ranges that all scores have."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Self

from bevcli.errors import ConfigError
from bevcli.geometry.matching import MATCH_DISTANCE_M
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass

# The devkit's names of the five true-positive errors, in m, 1 - IoU, radians, m/s, 1 - accuracy.
ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")


@dataclass(frozen=True)
class ClassRanges:
    """The ranges of a score."""

    # by class, the distance from the ego vehicle on the ground below which it is scored, metres
    class_ranges_m: Mapping[str, float]

    def cut_at(self, max_range_m: float) -> Self:
        """The same score with all class ranges cut at max_range_m. Raises ConfigError if it is not positive."""
        if not max_range_m > 0:
            raise ConfigError(f"the largest range is not positive (expected more than 0 m, found {max_range_m:g})")
        return replace(self, class_ranges_m={name: min(m, max_range_m) for name, m in self.class_ranges_m.items()})

    def unlimited(self) -> Self:
        """The same score without class ranges: the devkit's score of boxes without an ego pose."""
        return replace(self, class_ranges_m=dict.fromkeys(self.class_ranges_m, math.inf))

    def for_frames(self, max_range_m: float | None, *, ego_pose_known: bool) -> Self:
        """The score with the ranges that hold for frames: cut at max_range_m, if any; unlimited without ego poses."""
        if max_range_m is not None:
            return self.cut_at(max_range_m)
        return self if ego_pose_known else self.unlimited()


@dataclass(frozen=True)
class DetectionConfig(ClassRanges):
    """Parameters of the detection score; the defaults are the devkit's.

    Attributes:
        classes: the classes that are scored, by name.
        distances_m: matching distances of the centres on the ground, metres; one AP each.
        error_distance_m: the matching distance for true-positive errors and recall, metres.
        min_recall: precision at lower recall is ignored, 0 to 1.
        min_precision: lower precision counts as 0, 0 to 1.
        mean_ap_weight: weight of mAP in NDS; each error has weight 1.
        range_bins_m: rings around the ego vehicle for the table by range, lower end included, metres.
        visibility_bins: for the table by visibility, lower end included; the last bin includes 1.
    """

    class_ranges_m: Mapping[str, float] = field(default_factory=lambda: ranges_m(NUSCENES_CLASSES.values()))
    classes: Mapping[str, ObjectClass] = field(default_factory=lambda: NUSCENES_CLASSES)
    distances_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    error_distance_m: float = MATCH_DISTANCE_M
    min_recall: float = 0.1
    min_precision: float = 0.1
    mean_ap_weight: float = 5.0
    range_bins_m: tuple[tuple[float, float], ...] = ((0, 10), (10, 20), (20, 30), (30, 40), (40, 50))
    visibility_bins: tuple[tuple[float, float], ...] = ((0.0, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.0))

    @property
    def error_row(self) -> int:
        """Index of the matching distance for true-positive errors and recall."""
        return self.distances_m.index(self.error_distance_m)

    @classmethod
    def of(cls, classes: Mapping[str, ObjectClass]) -> Self:
        """The score of these classes, each within its range."""
        return cls(ranges_m(classes.values()), classes)

    def cut_at(self, max_range_m: float) -> Self:
        """The same score with all class ranges and bins cut at max_range_m. Raises ConfigError as `ClassRanges`."""
        bins = tuple((low, min(high, max_range_m)) for low, high in self.range_bins_m if low < max_range_m)
        return replace(super().cut_at(max_range_m), range_bins_m=bins)


def ranges_m(classes: Iterable[ObjectClass]) -> dict[str, float]:
    """The range of each class, by name."""
    return {object_class.name: object_class.range_m for object_class in classes}
