"""`bevcli stress`: its conditions, and the results that are kept and compared."""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
from command_line import invoked
from memory_drive import MemoryDrive

from bevcli.errors import InputError, OutputError
from bevcli.frame import Frame
from bevcli.inference import run
from bevcli.inference.load import Model
from bevcli.inference.runner import Runner
from bevcli.workshop.robustness.conditions import NAMES, choose_conditions
from bevcli.workshop.robustness.stress import (
    ConditionScores,
    StressOptions,
    StressResults,
    StressTest,
    read_results,
    stress,
    stress_table,
)
from bevcli.workshop.training.validation import drives_table, score_drives

FRAMES = 3
TRIED = ("clean", "frame_lost", "snow", "calibration_noise", "ego_motion_lost", "frame_rate")
CONDITIONS = [each for each in choose_conditions() if each.severity in ("", "hard", "4") and each.name in TRIED]


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
    assert tuple(scores) == TRIED
    assert scores["clean"]["mean_ap"] > 0.5
    assert len({(each["nd_score"], each["mean_ap"]) for each in scores.values()}) == len(TRIED)
    assert content(whole)["complete"]
    assert {path.name for path in whole.iterdir()} == {".bevcli", "stress.json"}
    assert not list((whole / ".bevcli").glob("boxes*"))


def test_the_clean_scores_are_those_of_validate(whole, model, drives):
    together = score_drives(Runner(model.prepared, model.device), DrivesInMemory(drives), each_drive=True)
    summary = together.summary()
    assert content(whole)["conditions"][0]["nd_score"] == pytest.approx(summary["NDS"], abs=1e-9)
    second = score_drives(Runner(model.prepared, model.device), DrivesInMemory(drives[1:])).summary()
    assert [(drive.name, drive.cameras) for drive in together.drives] == [("memory", 6), ("second", 6)]
    assert (together.drives[1].mean_ap, together.drives[1].nd_score) == (second["mAP"], second["NDS"])
    assert drives_table(together.drives).splitlines()[-1].startswith("mAP: mean 0.")


@pytest.mark.slow
def test_an_interrupted_test_resumed_gives_the_same_bytes(whole, model, drives, tmp_path):
    out, runs, is_complete = tmp_path / "out", 0, False
    while runs < 50 and not is_complete:
        test, runs = StressTest(model, drives, CONDITIONS, out, resume=True), runs + 1
        known = content(out)["conditions"] if out.exists() else []
        found = list(islice(test.run(), 9))  # as an early end of the loop
        assert not known or found[0] >= FRAMES  # finished scenes are not run again
        is_complete = test.results.is_complete
        assert content(out)["complete"] is is_complete
    assert runs > 3
    assert (out / "stress.json").read_bytes() == (whole / "stress.json").read_bytes()


@pytest.mark.slow
def test_a_resumed_test_may_get_more_conditions_no_other_options(whole, model, drives, tmp_path):
    for part in (CONDITIONS[3:4], CONDITIONS):
        stress(model, drives, part, tmp_path, resume=True)
    assert (tmp_path / "stress.json").read_bytes() == (whole / "stress.json").read_bytes()
    with pytest.raises(OutputError, match="option seed: was 0, is 1"):
        stress(model, drives, CONDITIONS, tmp_path, StressOptions(seed=1), resume=True)
    with pytest.raises(OutputError, match="`force=True`"):
        stress(model, drives, CONDITIONS, tmp_path)


@pytest.mark.slow
def test_another_seed_gives_other_scores(model, drives, tmp_path):
    part = [each for each in CONDITIONS if each.name in ("clean", "calibration_noise")]
    scores = []
    for seed in (0, 1):
        results = stress(model, drives, part, tmp_path / str(seed), StressOptions(seed=seed))
        scores.append([each.nd_score for each in results.scores])
    assert scores[0][0] == scores[1][0]
    assert scores[0][1] != scores[1][1]


def test_drives_and_conditions_that_cannot_be_are_refused(model, tmp_path):
    with pytest.raises(InputError, match="memory: has no ground truth"):
        stress(model, [MemoryDrive(2)], CONDITIONS[:1], tmp_path)
    with pytest.raises(InputError, match=r"rain.*camera_crash.*snow"):
        choose_conditions("all", ["rain"])
    for options in ([], ["samples/crossing", "--rendered", "1000000:1000001"]):
        with pytest.raises(InputError, match="SEQUENCE folders or --rendered SEEDS"):
            invoked("stress", *options)


# NDS as published, each the mean over three severities: clean, then camera crash, frame lost, colour quantisation,
# motion blur, brightness, low light, fog, snow.
BEVFORMER_BASE = (0.5174, 0.3154, 0.3017, 0.3509, 0.2695, 0.4184, 0.2515, 0.4069, 0.1857)
DETR3D = (0.4224, 0.2859, 0.2604, 0.3177, 0.2661, 0.4002, 0.2786, 0.3912, 0.1913)


def results(nds: tuple[float, ...], model: str = "base") -> StressResults:
    """Three severities whose mean is the published one."""
    scores = [ConditionScores("clean", "", nds[0], 0.4, {"trans_err": 0.5}, {"car": 0.6})]
    for name, value in zip(NAMES, nds[1:], strict=False):
        for severity, offset in (("easy", 0.05), ("mid", 0.01), ("hard", -0.06)):
            scores.append(ConditionScores(name, severity, value + offset, 0.2, {"vel_err": float("nan")}, {"car": 0.3}))
    return StressResults({"model": model, "drives": []}, tuple(scores))


def test_means_of_bevformer_base_are_the_published_ones():
    own, other = results(BEVFORMER_BASE), results(DETR3D)
    assert 100 * own.mean_resilience() == pytest.approx(60.40, abs=0.01)
    assert 100 * other.mean_resilience() == pytest.approx(70.77, abs=0.01)
    assert 100 * own.mean_corruption_error(other) == pytest.approx(97.97, abs=0.01)
    assert own.mean_corruption_error(own) == 1
    assert own.differences(other) == ()
    assert own.differences(StressResults({**other.header, "seed": 3}, other.scores)) == ("seed",)


def test_stress_json_is_read_back(tmp_path):
    written = results(BEVFORMER_BASE)
    path = tmp_path / "stress.json"
    path.write_text(json.dumps(written.to_dict()))
    read = read_results(path)
    assert read.mean_resilience() == written.mean_resilience()
    assert json.dumps(read.to_dict()["conditions"]) == json.dumps(written.to_dict()["conditions"])


@pytest.mark.parametrize("content", ["{}", "[]", '{"format": "bevcli-stress/1", "conditions": [{"mean_ap": 0.1}]}'])
def test_another_file_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "stress.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"stress\.json"):
        read_results(path)


def test_the_table_has_a_row_per_corruption_and_the_means():
    table = stress_table(results(BEVFORMER_BASE), results(DETR3D, "detr3d"))
    for name in NAMES[:8]:
        assert f"\n{name} " in table
    assert "mRR 60.4 % over 8 of RoboBEV's 8 corruptions" in table
    assert "mCE 98.0 % against detr3d over 8 of RoboBEV's 8 corruptions" in table


def test_conditions_are_clean_and_each_corruption_by_severity():
    everything = choose_conditions()
    assert len(everything) == 1 + 8 * 3 + 5 * 3 + 4 + 4 * 3
    assert everything[0].name == "clean"
    easy = choose_conditions("easy", ["fog", "calibration_noise"])
    assert [(each.name, each.severity) for each in easy] == [("clean", ""), ("fog", "easy"), ("calibration_noise", "1")]


def test_the_levels_are_the_published_ones():
    levels = {each.name: [] for each in choose_conditions()}
    for each in choose_conditions()[1:]:
        levels[each.name].append(each.corruption.levels[each.severity])
    for name in ("camera_crash", "frame_lost", "motion_blur", "brightness", "fog"):
        assert levels[name] == [2, 4, 5]
    assert levels["color_quantisation"] == levels["snow"] == [1, 2, 3]
    assert levels["low_light"] == [2, 3, 4]
    assert levels["calibration_noise"] == [1, 2, 3, 4]
