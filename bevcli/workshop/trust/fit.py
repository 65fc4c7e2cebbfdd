"""A fit: how figures of known weights go with their true NDS. The files are in `fits`, one for each file of weights."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.workshop.trust.figures import Figures, scores_of


@dataclass(frozen=True)
class Fit:
    """NDS = intercept + the sum of weights times figures, at least 0, for one file of weights.

    `tests/tools/fit_estimate.py` makes it from rendered drives.

    Attributes:
        weights_hash: of the weights, see `Model.weights_hash`.
        drives: number of drives that the figures and the true scores are from.
        conditions: number of their conditions: images as rendered or corrupted, each scored alone.
        least_frames: shorter drives get no NDS.
        intercept: of the sum.
        weights: figure -> NDS for each unit of it.
        lowest: figure -> its lowest value in the fitted conditions. The interval does not hold below it.
        highest: figure -> its highest value.
        half_width: half of the interval that holds the NDS of 9 of 10 conditions of drives that were left out.
        precision_slope: of the logarithm of odds that a box is right, for each unit of that of its score.
        precision: class -> the logarithm of odds at a score of 0.5.
    """

    weights_hash: str
    drives: int
    conditions: int
    least_frames: int
    intercept: float
    weights: Mapping[str, float]
    lowest: Mapping[str, float]
    highest: Mapping[str, float]
    half_width: float
    precision_slope: float
    precision: Mapping[str, float]

    def nd_score(self, figures: Figures) -> float | None:
        """The estimated NDS, 0 to 1; None for a drive that is too short, or where a figure could not be measured."""
        terms = [weight * getattr(figures, name) for name, weight in self.weights.items()]
        if figures.frames < self.least_frames or not np.isfinite(terms).all():
            return None
        return float(np.clip(self.intercept + sum(terms), 0, 1))

    def outside(self, figures: Figures) -> list[str]:
        """The figures that lie outside those of the fitted conditions, by name."""
        values = {name: getattr(figures, name) for name in self.weights}
        return [name for name, value in values.items() if not self.lowest[name] <= value <= self.highest[name]]

    def right(self, boxes: Boxes3D) -> Array:
        """(N,) the expected share of boxes of such a class and score that are right: within 2 m of a true object."""
        scores = np.clip(scores_of(boxes), 0.01, 0.99)
        of_class = np.array([self.precision[name] for name in boxes.classes.tolist()])
        odds = of_class + self.precision_slope * np.log(scores / (1 - scores))
        return np.asarray(1 / (1 + np.exp(-odds)))
