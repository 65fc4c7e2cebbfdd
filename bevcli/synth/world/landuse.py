"""What a block of the city is used for."""

from __future__ import annotations

from typing import Literal

from bevcli.synth.world.city import CityPlan

Landuse = Literal["houses", "park", "site"]


def landuse(city: CityPlan, column: int, row: int) -> Landuse:
    """Houses mostly; one block in seven is a park, one in six a building site."""
    share = city.stream("landuse", column, row).random()
    if share < 0.14:
        return "park"
    return "site" if share < 0.30 else "houses"
