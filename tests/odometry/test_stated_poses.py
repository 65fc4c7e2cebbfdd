"""Stated poses against the measured motion: each planted mistake is named with its number, and sound poses are not."""

import re
from dataclasses import replace

import numpy as np
import pytest
from stated_mistakes import (
    DEVIATIONS,
    EVERY,
    FIRST,
    FRAMES,
    MISTAKES,
    POSITIONS,
    SHOWN,
    TIMES,
    YAWS,
    antenna,
    drive,
    jumping,
    measured,
    planar,
    stated,
    turned,
)

from bevcli.workshop.odometry.compare import compare


@pytest.mark.parametrize("name", MISTAKES)
def test_a_planted_mistake_is_the_only_finding(name):
    poses, code, message, found = MISTAKES[name]
    (finding,) = compare(poses, SHOWN)
    assert finding.code == code, finding
    assert message in finding.message
    assert found in finding.found
    assert finding.severity == ("warning" if name in ("wheel", "a little turned", "early", "antenna") else "error")


@pytest.mark.parametrize("seed", range(4))
def test_sound_poses_have_no_finding(seed):
    times, positions, yaws = drive(seed=seed, turning=seed % 3, changing=seed % 2)
    noise = 0.01 * np.random.default_rng(seed).standard_normal(positions.shape)
    shown = measured(times, positions, yaws, seed)
    assert compare(planar(positions + noise, yaws, times), shown) == ()
    rows = np.arange(FIRST, FIRST + EVERY * FRAMES, EVERY)  # and with the poses of the frames alone
    assert compare(planar(positions[rows], yaws[rows], times[rows]), shown) == ()


@pytest.mark.parametrize(
    ("poses", "number", "true"),
    [
        (stated(times_ns=TIMES + 180_000_000), r"are (\d+) ± (\d+) ms too late", 180),
        (stated(times_ns=TIMES + 5_000_000_000), r"are (\d+) ± (\d+) ms too late", 5000),
        (stated(1.08 * POSITIONS), r"^(\d+.\d+) ± (\d+.\d+) times", 1.08),
        (turned(-6), r"points (\d+.\d+)° ± (\d+.\d+)° to the right", 6),
        (antenna((2.4, 0, 0)), r"^x \+(\d+.\d+) ± (\d+.\d+) m", 2.4),
    ],
)
def test_a_number_is_within_3_deviations(poses, number, true):
    (finding,) = compare(poses, SHOWN)
    value, deviation = map(float, re.search(number, finding.found).groups())
    assert abs(value - true) < 3 * deviation
    assert deviation < max(0.1 * true, 0.3)


def test_two_mistakes_have_two_findings():
    findings = compare(stated(3.6 * POSITIONS, np.pi / 2 - YAWS), SHOWN)
    assert [finding.code for finding in findings] == ["motion-angles", "motion-scale"]


def test_poses_of_the_frames_alone_show_another_time():
    rows = np.arange(FIRST, FIRST + EVERY * FRAMES, EVERY)
    (finding,) = compare(planar(POSITIONS[rows], YAWS[rows], TIMES[rows] + 500_000_000), SHOWN)
    assert finding.code == "motion-time"
    assert re.search(r"are (49|50)\d ", finding.found)


def test_images_that_stand_still_are_told():
    shown = measured(TIMES, 0 * POSITIONS, 0 * YAWS)
    (finding,) = compare(stated(), shown)
    assert (finding.code, finding.severity) == ("motion-stands", "error")
    assert "the images stand still" in finding.message
    assert compare(stated(0 * POSITIONS, 0 * YAWS), shown) == ()


def test_frames_of_a_jump_have_the_given_numbers():
    (finding,) = compare(jumping(), SHOWN, range(40, 49))
    assert "between frames 43 and 44" in finding.found


def test_wide_deviations_are_no_comparison():
    wide = measured(TIMES, POSITIONS, YAWS, deviations=100 * DEVIATIONS)
    guessed = measured(TIMES, POSITIONS, YAWS, reason="too dark")
    for shown, text in ((wide, "0 steps could be measured"), (guessed, "0 steps could be measured: too dark")):
        (finding,) = compare(stated(3.6 * POSITIONS), shown)
        assert (finding.code, finding.severity) == ("motion-not-compared", "info")
        assert text in finding.message


def test_a_bad_measurement_of_one_step_is_no_jump():
    steps = list(SHOWN.steps)
    half = steps[3].ego_a_from_ego_b.copy()
    half[:3, 3] /= 2
    steps[3] = replace(steps[3], ego_a_from_ego_b=half)
    assert compare(stated(), replace(SHOWN, steps=tuple(steps))) == ()
