"""The option `score_without_labels` of `bevcli run`. Every run imports this file."""

from pathlib import Path
from typing import TYPE_CHECKING

from bevcli.cli.bridge import Extension
from bevcli.options import option, options
from bevcli.printing import say

if TYPE_CHECKING:
    from bevcli.frame import Drive
    from bevcli.inference.load import Model


@options("Output")
class ScoreWithoutLabelsOptions:
    """Whether the score of a run is estimated."""

    score_without_labels: bool = option(
        default=False,
        help="Print the NDS that the boxes are likely to have, with an interval; the drive needs no ground truth.",
    )


def _print_estimate(options: ScoreWithoutLabelsOptions, done: "tuple[Model, Drive, Path]") -> None:
    """Print the estimated score of a run, where this is asked for. done: the model, the drive and the run's folder."""
    if not options.score_without_labels:
        return
    from bevcli.workshop.trust.estimate import estimate_of_run
    from bevcli.workshop.trust.faults import find_faults

    model, drive, folder = done
    say(estimate_of_run(model, folder, drive.rig).with_faults(find_faults(model, drive)).table())


SCORE_WITHOUT_LABELS = Extension(ScoreWithoutLabelsOptions, _print_estimate)
