"""Scores of a further kind of results: a registered `Scorer` has its option, its table and its part of the JSON."""

import json

import pytest
import typer
from random_boxes import as_predictions, random_truth
from test_eval_command import write_frames
from typer.testing import CliRunner

from bevcli import registry
from bevcli.cli.bridge import command
from bevcli.cli.commands import evaluate as eval_command
from bevcli.cli.main import PlainCommand
from bevcli.evaluation import Scorer
from bevcli.evaluation.evaluate import evaluate
from bevcli.geometry.transforms import Pose
from bevcli.options import option, options
from bevcli.registered import OWN


@options()
class CountOptions:
    """Whether boxes are counted."""

    counts: bool = option(default=False, help="Also count the boxes.")


class Counts:
    """The number of predicted boxes without a true one."""

    def __init__(self, options, compared):
        predicted, true = compared.pairs.boxes
        self.surplus = sum(map(len, predicted)) - sum(map(len, true))
        self.notes = (f"counted: {options.counts}",)

    def to_dict(self):
        return {"surplus": self.surplus}

    def tables(self):
        yield f"{self.surplus} boxes too many"


SCORER = Scorer(CountOptions, f"{__name__}:Counts")


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Predictions with two false boxes in each of three frames, and their ground truth; the scorer is registered."""
    monkeypatch.setitem(OWN, "bevcli.scores", {"counts": f"{__name__}:SCORER"})
    registry.entries.cache_clear()
    truth = random_truth(5, frames=3)
    predictions = as_predictions(truth, 5, false_per_frame=2)
    yield [
        str(write_frames(tmp_path / f"{name}.json", frames, pose=Pose.identity()))
        for name, frames in (("predictions", predictions), ("truth", truth))
    ]
    registry.entries.cache_clear()


def test_its_option_table_and_json_are_those_of_eval(files):
    app = typer.Typer()
    app.command(cls=PlainCommand)(command(eval_command))
    assert "Also count the boxes." in CliRunner().invoke(app, ["--help"]).stdout
    shown = CliRunner().invoke(app, [*files, "--counts"], catch_exceptions=False)
    assert shown.stdout.endswith("\n\n6 boxes too many\n")
    scores = json.loads(CliRunner().invoke(app, [*files, "--counts", "--json"], catch_exceptions=False).stdout)
    assert scores["surplus"] == 6
    assert "surplus" not in json.loads(CliRunner().invoke(app, [*files, "--json"], catch_exceptions=False).stdout)


def test_from_python_its_scores_have_its_name(files):
    scores = evaluate(*files, counts=True)
    assert scores.counts.surplus == 6
    assert scores.notes[-1] == "counted: True"
    assert not hasattr(evaluate(*files, counts=False), "counts")
    with pytest.raises(TypeError, match="no option `count`"):
        evaluate(*files, count=True)
