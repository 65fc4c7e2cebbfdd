"""The choice among the motions that each step may have."""

from dataclasses import replace

import numpy as np

from bevcli.workshop.odometry.measure import Chain, leaps
from bevcli.workshop.odometry.steps import Candidate


def driven(distance: float, votes: float, yaw: float = 0.0) -> Candidate:
    """A motion along x."""
    return Candidate(np.array([0, 0, yaw, distance, 0, 0, 0, 0]), np.eye(6), votes, 0, 0)


def chosen(steps: list[list[Candidate]], seconds: float = 0.5) -> list[float]:
    """The distances that the chain decides."""
    chain = Chain()
    decided = [chain.add(step, seconds) for step in steps] + [chain.end()]
    return [float(each.state[3]) for each in decided if each is not None]


def test_the_neighbours_decide_where_votes_are_about_equal() -> None:
    right, wrong = driven(4.0, 4.0), driven(1.0, 4.1)
    assert chosen([[driven(4.1, 5.0)], [wrong, right], [driven(3.9, 5.0)]]) == [4.1, 4.0, 3.9]
    assert chosen([[wrong, right], [driven(4.0, 5.0)]]) == [4.0, 4.0]  # the next step decides about the first
    assert chosen([[driven(4.0, 5.0)], [wrong, right]]) == [4.0, 4.0]


def test_many_votes_outweigh_a_change_of_speed() -> None:
    assert chosen([[driven(4.0, 5.0)], [driven(3.0, 9.0), driven(4.0, 2.0)]]) == [4.0, 3.0]


def test_backwards_is_not_the_same_speed() -> None:
    assert chosen([[driven(-2.0, 5.0)], [driven(2.0, 4.1), driven(-2.0, 4.0)]]) == [-2.0, -2.0]


def test_a_leap_with_few_points_of_the_road_is_not_believed() -> None:
    before, short, after = driven(4.0, 1.0), driven(0.9, 1.0), driven(4.2, 1.0)
    times = 0.5, 0.5, 0.5
    assert leaps(before, short, after, times)
    assert not leaps(before, replace(short, road_points=400), after, times)
    assert not leaps(before, short, driven(0.2, 1.0), times)  # it brakes
    assert not leaps(before, driven(3.5, 1.0), after, times)


def test_a_step_is_decided_one_step_later() -> None:
    chain = Chain()
    first, second = driven(1.0, 1.0), driven(1.1, 1.0)
    assert chain.add([first], 0.5) is None
    assert chain.likeliest is first
    assert chain.add([second], 0.5) is first
    assert chain.end() is second
    assert chain.end() is None
