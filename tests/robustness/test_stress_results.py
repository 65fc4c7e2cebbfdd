"""mRR and mCE against RoboBEV's published numbers, stress.json, the table and the choice of conditions."""

import json

import pytest

from bevcli.errors import InputError
from bevcli.workshop.robustness.conditions import NAMES, choose_conditions
from bevcli.workshop.robustness.stress import ConditionScores, StressResults, read_results, stress_table

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


def test_mean_resilience_of_bevformer_base_is_the_published_one():
    assert 100 * results(BEVFORMER_BASE).mean_resilience() == pytest.approx(60.40, abs=0.01)
    assert 100 * results(DETR3D).mean_resilience() == pytest.approx(70.77, abs=0.01)


def test_mean_corruption_error_to_detr3d_is_the_published_one():
    assert 100 * results(BEVFORMER_BASE).mean_corruption_error(results(DETR3D)) == pytest.approx(97.97, abs=0.01)


def test_a_model_has_a_corruption_error_of_1_against_itself():
    own = results(BEVFORMER_BASE)
    assert own.mean_corruption_error(own) == 1


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
    with pytest.raises(InputError, match=r"stress\.json") as error:
        read_results(path)
    assert "\n" not in str(error.value)


def test_the_table_has_a_row_per_corruption_and_the_means():
    table = stress_table(results(BEVFORMER_BASE), results(DETR3D, "detr3d"))
    for name in NAMES[:8]:
        assert f"\n{name} " in table
    assert "mRR 60.4 % over 8 of RoboBEV's 8 corruptions" in table
    assert "mCE 98.0 % against detr3d over 8 of RoboBEV's 8 corruptions" in table


def test_differences_of_the_tests_are_named():
    own, other = results(BEVFORMER_BASE), results(DETR3D)
    assert own.differences(other) == ()
    assert own.differences(StressResults({**other.header, "seed": 3}, other.scores)) == ("seed",)


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


def test_an_unknown_corruption_is_refused_with_the_known_names():
    with pytest.raises(InputError, match=r"rain.*camera_crash.*snow"):
        choose_conditions("all", ["rain"])
