"""Objects that stand along the streets."""

import pytest

from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.city import STOP_LINE_M, CityPlan
from bevcli.workshop.synth.simulation import Roadside, StandingActor

WORKS = ("barrier-", "cone-", "machine-", "worker-")


class EvenCity(CityPlan):
    """A city whose streets all have the same distance."""

    def __init__(self, seed: int, spacing_m: float) -> None:
        super().__init__(seed)
        self.spacing_m = spacing_m

    def _make_position(self, axis: int, index: int) -> float:
        return index * self.spacing_m


def standing(city: CityPlan, assets: Assets) -> list[tuple[StandingActor, int, int, int]]:
    """The actors at the kerbs of 60 stretches, each with axis, street and crossing street."""
    roadside = Roadside(city, assets)
    stretches = [(axis, index, cross) for axis in (0, 1) for index in range(5) for cross in range(6)]
    return [(actor, *stretch) for stretch in stretches for actor in roadside.stretch(*stretch)]


@pytest.mark.parametrize(("spacing_m", "has_works"), [(45.0, False), (100.0, True)])
def test_only_stretches_with_room_have_road_works(assets: Assets, spacing_m: float, has_works: bool):
    """Road works are at least 15 m long. With 45 m between the streets no stretch has that much room."""
    names = [actor.body.instance for actor, *_ in standing(EvenCity(3, spacing_m), assets)]
    assert any(name.startswith("parked") for name in names)
    assert any(name.startswith(WORKS) for name in names) == has_works


@pytest.mark.parametrize("spacing_m", [45.0, 66.0, 100.0])
def test_all_at_a_kerb_is_between_stop_lines_on_the_parking_lane(assets: Assets, spacing_m: float):
    city = EvenCity(3, spacing_m)
    checked = 0
    for actor, axis, index, cross in standing(city, assets):
        street = city.street(axis, index)
        before, after = city.street(1 - axis, cross), city.street(1 - axis, cross + 1)
        plan = city.unbend(actor.position[:2])
        along, across = plan[axis], abs(plan[1 - axis] - street.position)
        half = actor.body.size_lwh[0] / 2 if actor.body.instance.startswith("parked") else 0.0
        assert along - half > before.position + before.half_width + STOP_LINE_M
        assert along + half < after.position - after.half_width - STOP_LINE_M
        assert street.half_width - street.parking_m - 0.5 < across < street.half_width
        checked += 1
    assert checked > 50
