"""The files of a stress test: its state for --resume, stress.json, and the figures."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence as Items
from dataclasses import dataclass

from bevcli.errors import OutputError
from bevcli.frame import Sequence
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.run_folder import RunFolder
from bevcli.pipeline.run_state import run_facts
from bevcli.pipeline.state_file import digest
from bevcli.robustness.conditions import Condition
from bevcli.robustness.contact_sheet import SheetOptions, write_contact_sheet
from bevcli.robustness.results import ConditionScores, StressResults

RESULTS, SHEET, PLOT = "stress.json", "corruptions.png", "stress.png"
_INPUT_FACTS = ("frames of the input", "calibration", "files of the input")


@dataclass(frozen=True)
class StressState:
    """A test after a number of finished conditions, for --resume.

    Attributes:
        facts: what the results depend on, see `run_facts`.
        scores: of the finished conditions.
    """

    facts: dict[str, str]
    scores: tuple[ConditionScores, ...] = ()

    def has(self, condition: Condition) -> bool:
        """Whether a condition is finished."""
        return any((each.corruption, each.severity) == (condition.name, condition.severity) for each in self.scores)


def stress_facts(model: Model, drives: Items[Sequence], options: object) -> dict[str, str]:
    """What the results depend on, apart from the conditions. options: the dataclass of the test's options."""
    each = [run_facts(model, drive, options) for drive in drives]
    facts = dict(each[0])
    if len(each) > 1:
        facts |= {name: digest(tuple(one[name] for one in each))[:12] for name in _INPUT_FACTS}
    return facts | {"drives": ", ".join(drive.name for drive in drives)}


def write_results(folder: RunFolder, results: StressResults, against: StressResults | None) -> None:
    """Writes stress.json; the file is replaced at once."""
    path = folder.path / RESULTS
    folder.add(path)
    fresh = path.with_name(path.name + ".new")
    try:
        fresh.write_text(json.dumps(results.to_dict(against), indent=1) + "\n")
        os.replace(fresh, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None


def write_figures(
    folder: RunFolder,
    results: StressResults,
    against: StressResults | None,
    scene: Sequence,
    conditions: Items[Condition],
    options: SheetOptions,
) -> None:
    """Writes the plot, and a contact sheet of a scene."""
    from bevcli.evaluation.plots import save_figures  # only plots need matplotlib
    from bevcli.robustness.report import draw_stress

    folder.add(folder.path / SHEET)
    write_contact_sheet(folder.path / SHEET, scene, conditions, options)
    if results.tested():
        folder.add(folder.path / PLOT)
        save_figures({PLOT: draw_stress(results, against)}, folder.path)
