"""The stress test as a whole: repeatable to the byte, resumable, and clean scores equal those of `bevcli validate`."""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
from memory_drive import MemoryDrive
from typer.testing import CliRunner

from bevcli.cli.main import app
from bevcli.errors import InputError, OutputError
from bevcli.frame import Frame
from bevcli.inference.load import Model
from bevcli.inference.run import run
from bevcli.inference.runner import Runner
from bevcli.workshop.robustness.conditions import choose_conditions
from bevcli.workshop.robustness.stress import StressOptions, StressTest, stress
from bevcli.workshop.training.validation import drives_table, validate

FRAMES = 3
NAMES = ("clean", "frame_lost", "snow", "calibration_noise", "ego_motion_lost", "frame_rate")
CONDITIONS = [each for each in choose_conditions() if each.severity in ("", "hard", "4") and each.name in NAMES]


class SelfLabelledDrive(MemoryDrive):
    """The noise drive; its ground truth is what the model finds in the clean images, so that scores are high."""

    def __init__(self, model: Model, name: str = "memory") -> None:
        super().__init__(FRAMES)
        self.name = name
        self.truth = [p.boxes_world[:6] for _, p in run(model, MemoryDrive(FRAMES), track=False)]

    def load(self, index: int) -> Frame:
        return replace(super().load(index), ground_truth=self.truth[index])


class DrivesInMemory(list):
    """A list of drives as `Drives`."""

    input_shapes = None

    def open(self, index):
        return self[index]


@pytest.fixture(scope="module")
def model(mini_model) -> Model:
    return Model(mini_model)


@pytest.fixture(scope="module")
def drives(model):
    return [SelfLabelledDrive(model), SelfLabelledDrive(model, "second")]


@pytest.fixture(scope="module")
def whole(model, drives, tmp_path_factory) -> Path:
    """The folder of an uninterrupted test."""
    out = tmp_path_factory.mktemp("stress") / "whole"
    results = stress(model, drives, CONDITIONS, out)
    assert results.is_complete
    return out


def content(out: Path) -> dict:
    return json.loads((out / "stress.json").read_text())


def test_every_condition_is_scored_and_changes_the_predictions(whole):
    scores = {each["corruption"]: each for each in content(whole)["conditions"]}
    assert tuple(scores) == NAMES
    assert scores["clean"]["mean_ap"] > 0.5
    assert len({(each["nd_score"], each["mean_ap"]) for each in scores.values()}) == len(NAMES)
    assert content(whole)["complete"]
    assert {path.name for path in whole.iterdir()} == {".bevcli", "stress.json"}
    assert not list((whole / ".bevcli").glob("boxes*"))


def test_the_clean_scores_are_those_of_validate(whole, model, drives):
    together = validate(Runner(model.prepared, model.device), DrivesInMemory(drives), each_drive=True)
    summary = together.summary()
    assert content(whole)["conditions"][0]["nd_score"] == pytest.approx(summary["NDS"], abs=1e-9)
    second = validate(Runner(model.prepared, model.device), DrivesInMemory(drives[1:])).summary()
    assert [(drive.name, drive.cameras) for drive in together.drives] == [("memory", 6), ("second", 6)]
    assert (together.drives[1].mean_ap, together.drives[1].nd_score) == (second["mAP"], second["NDS"])
    assert drives_table(together.drives).splitlines()[-1].startswith("mAP: mean 0.")


def test_an_interrupted_test_resumed_gives_the_same_bytes(whole, model, drives, tmp_path):
    out, runs, is_complete = tmp_path / "out", 0, False
    while runs < 50 and not is_complete:
        test, runs = StressTest(model, drives, CONDITIONS, out, resume=True), runs + 1
        list(islice(test.run(), 9))  # as an early end of the loop
        is_complete = test.results.is_complete
        assert content(out)["complete"] is is_complete
    assert runs > 3
    assert (out / "stress.json").read_bytes() == (whole / "stress.json").read_bytes()


def test_finished_scenes_are_not_run_again(model, drives, tmp_path):
    for done in StressTest(model, drives, CONDITIONS[:2], tmp_path).run():
        if done == FRAMES + 2:
            break
    known, *again = StressTest(model, drives, CONDITIONS[:2], tmp_path, resume=True).run()
    assert known == FRAMES  # the first drive of the clean condition
    assert len(again) == 2 * 2 * FRAMES - FRAMES


@pytest.mark.slow
def test_a_resumed_test_may_get_more_conditions_no_other_options(whole, model, drives, tmp_path):
    for part in (CONDITIONS[3:4], CONDITIONS):
        stress(model, drives, part, tmp_path, resume=True)
    assert (tmp_path / "stress.json").read_bytes() == (whole / "stress.json").read_bytes()
    with pytest.raises(OutputError, match="option seed: was 0, is 1"):
        stress(model, drives, CONDITIONS, tmp_path, StressOptions(seed=1), resume=True)
    with pytest.raises(OutputError, match="`force=True`"):
        stress(model, drives, CONDITIONS, tmp_path)


def test_another_seed_gives_other_scores(model, drives, tmp_path):
    part = [each for each in CONDITIONS if each.name in ("clean", "calibration_noise")]
    scores = []
    for seed in (0, 1):
        results = stress(model, drives, part, tmp_path / str(seed), StressOptions(seed=seed))
        scores.append([each.nd_score for each in results.scores])
    assert scores[0][0] == scores[1][0]
    assert scores[0][1] != scores[1][1]


def test_a_drive_without_ground_truth_is_refused(model, tmp_path):
    with pytest.raises(InputError, match="memory: has no ground truth"):
        stress(model, [MemoryDrive(2)], CONDITIONS[:1], tmp_path)


def test_the_command_needs_one_kind_of_drives():
    for options in ([], ["samples/crossing", "--rendered", "1000000:1000001"]):
        answer = CliRunner().invoke(app, ["stress", *options])
        assert isinstance(answer.exception, InputError)
        assert "SEQUENCE folders or --rendered SEEDS" in str(answer.exception)
