"""The estimated score: it rises with its figures, has an interval, and needs a fit for the weights."""

import json
import shutil
from pathlib import Path

import pytest
from test_figures import RIG, cars, frame
from typer.testing import CliRunner

import bevcli
from bevcli.cli.main import app
from bevcli.findings import Finding
from bevcli.workshop.trust import estimate
from bevcli.workshop.trust.estimate import EstimatedScore, estimate_of_boxes, fits

STREET = Path(__file__).parents[2] / "samples" / "street"


@pytest.fixture(scope="module")
def model() -> bevcli.Model:
    return bevcli.load_model("demo", device="cpu")


def standing(model: bevcli.Model, score: float, frames: int = 12, jump_m: float = 0.0) -> EstimatedScore:
    """The estimate for ten standing cars. jump_m: how far each is from where it was in the frame before."""
    rows = [[(3.0 * k - 15 + jump_m * (i % 2), 5.0, 0.0, 0.0) for k in range(10)] for i in range(frames)]
    return estimate_of_boxes(model, [frame(i, cars(*row, score=score)) for i, row in enumerate(rows)], RIG)


def test_the_estimate_rises_with_scores_and_persistence(model: bevcli.Model) -> None:
    low, jumping, high = standing(model, 0.4), standing(model, 0.8, jump_m=1.4), standing(model, 0.8)
    assert None not in (low.nd_score, jumping.nd_score, high.nd_score)
    assert low.nd_score < jumping.nd_score < high.nd_score


def test_the_interval_is_that_of_the_file(model: bevcli.Model) -> None:
    found, fit = standing(model, 0.4), fits()[model.weights_hash]
    assert None not in (found.low, found.nd_score, found.high)
    assert found.high - found.nd_score == pytest.approx(found.nd_score - found.low) == pytest.approx(fit.half_width)


def test_figures_that_no_fitted_drive_had_are_named(model: bevcli.Model) -> None:
    assert any(note.startswith("certainty is 0.1, outside") for note in standing(model, 0.1).notes)


def test_faults_come_with_a_note_that_the_score_is_lower(model: bevcli.Model) -> None:
    fault = Finding("camera-dead", "error", None, "its images show nothing", "", "", "")
    assert standing(model, 0.8).with_faults((fault,)).notes[-1] == estimate.FAULTY
    assert estimate.FAULTY not in standing(model, 0.8).with_faults(()).notes


def test_a_drive_without_boxes_gets_a_low_score(model: bevcli.Model) -> None:
    found = estimate_of_boxes(model, [frame(index, cars()) for index in range(12)], RIG)
    assert found.nd_score == 0


def test_weights_without_a_fit_get_no_score(model: bevcli.Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "fits", dict)
    found = standing(model, 0.6)
    assert (found.nd_score, found.low, found.high) == (None, None, None)
    assert "no fit" in found.notes[0]
    assert found.figures.confidence == pytest.approx(0.4)
    assert found.line == "estimated NDS -"


def test_a_short_drive_gets_no_score(model: bevcli.Model) -> None:
    found = standing(model, 0.6, frames=2)
    assert found.nd_score is None
    assert "2 frames" in found.notes[0]


def test_expected_precision_rises_with_the_score(model: bevcli.Model) -> None:
    low, high = (standing(model, score).by_class["car"] for score in (0.4, 0.8))
    assert low.boxes == high.boxes == 10
    assert 0 < low.precision < high.precision < 1


@pytest.fixture(scope="module")
def unlabelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample drive without its ground truth."""
    folder = tmp_path_factory.mktemp("drives") / "unlabelled"
    shutil.copytree(STREET, folder, ignore=shutil.ignore_patterns("ground_truth*"))
    return folder


@pytest.mark.slow
def test_validate_estimates_where_there_is_no_ground_truth(unlabelled: Path) -> None:
    truth = bevcli.validate("demo", data=str(STREET)).summary()["NDS"]
    printed = CliRunner().invoke(app, ["validate", "--data", str(unlabelled), "--json"])
    found = json.loads(printed.stdout)["estimated"]
    assert 0 <= found["low"] < found["nd_score"] < found["high"] <= 1
    assert found["low"] <= truth <= found["high"]


@pytest.mark.slow
def test_run_prints_the_same_estimate_from_its_files(unlabelled: Path, tmp_path: Path) -> None:
    model = bevcli.load_model("demo", device="cpu")
    expected = bevcli.estimate_score(model, bevcli.open_sequence(unlabelled))
    command = ["run", str(unlabelled), "--score-without-labels", "--out", str(tmp_path / "out")]
    printed = CliRunner().invoke(app, command)
    assert printed.exit_code == 0, printed.output
    assert expected.line in printed.stdout
