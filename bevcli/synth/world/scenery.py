"""Objects without annotations: kerbs, houses, trees, street furniture and traffic signals."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array
from bevcli.synth.assets.mesh import joined
from bevcli.synth.assets.street_furniture import TREE_KINDS, StreetFurniture
from bevcli.synth.assets.triangles import MeshTemplate, PlacedMesh, TriangleSoup
from bevcli.synth.world.buildings import House, houses, kerb_slab
from bevcli.synth.world.city import CORNER_M, KERB_M, Block, CityPlan, rounded_rectangle
from bevcli.synth.world.route import DIRECTIONS, node_center, right_of, street_of
from bevcli.synth.world.signals import Signals

SIGNALS_REACH_M = 110.0  # traffic signals are drawn within this distance


class Scenery:
    """The scenery of a city. Blocks are made when they are first needed, and kept."""

    def __init__(self, city: CityPlan, furniture: StreetFurniture) -> None:
        self.city, self.furniture = city, furniture
        self._blocks: dict[tuple[int, int], list[PlacedMesh]] = {}

    def around(self, center: ArrayLike, reach_m: float) -> TriangleSoup:
        """Meshes within `reach_m` metres of a world point (2,)."""
        x, y = self.city.unbend(center)
        columns = self.city.streets_between(1, x - reach_m, x + reach_m)
        rows = self.city.streets_between(0, y - reach_m, y + reach_m)
        found: list[PlacedMesh] = []
        for i in range(columns[0].index - 1, columns[-1].index + 1):
            for j in range(rows[0].index - 1, rows[-1].index + 1):
                found += self._block(i, j)
        at = np.asarray(center, dtype=np.float64)
        near = [mesh for mesh in found if np.hypot(*(mesh.sphere[:2] - at)) < reach_m + mesh.sphere[3]]
        # Draw walls first, near ones before far ones: they hide most of the rest, which is then skipped.
        near.sort(key=lambda mesh: (len(mesh.triangles.facades) == 0, float(np.hypot(*(mesh.sphere[:2] - at)))))
        return TriangleSoup.gather(near, [-1] * len(near))

    def _block(self, column: int, row: int) -> list[PlacedMesh]:
        key = (column, row)
        if key not in self._blocks:
            self._blocks[key] = self._make(self.city.block(column, row))
        return self._blocks[key]

    def _make(self, land: Block) -> list[PlacedMesh]:
        slab = kerb_slab(self.city, rounded_rectangle(land.low, land.high, CORNER_M))
        meshes = [PlacedMesh.from_mesh(slab)]
        use = self.city.landuse(land.column, land.row)
        if use == "houses":
            for house in houses(self.city, land):
                meshes += _house_meshes(house)
        rng = self.city.stream("furniture", land.column, land.row)
        if use == "park":
            meshes += self._park(land, rng)
        for side in range(4):
            meshes += self._side(land, side, rng)
        return meshes

    def _park(self, land: Block, rng: np.random.Generator) -> list[PlacedMesh]:
        """Trees and bushes all over a block."""
        south, east, north, west = land.sidewalks
        low = np.array([land.low[0] + west + 1.5, land.low[1] + south + 1.5])
        high = np.array([land.high[0] - east - 1.5, land.high[1] - north - 1.5])
        count = int(np.prod(high - low) / 75)
        meshes = []
        for point in low + rng.random((count, 2)) * (high - low):
            kinds = self.furniture.trees if rng.random() < 0.7 else self.furniture.bushes
            meshes.append(self._put(kinds[int(rng.integers(len(kinds)))], point, rng.uniform(0, 6.3)))
        return meshes

    def _side(self, land: Block, side: int, rng: np.random.Generator) -> list[PlacedMesh]:
        """The pavement on one side of a block: trees, lamps and signs near the kerb, benches and bins between them."""
        start, end, inward = land.side(side)
        street = self.city.street(side % 2, (land.row, land.column + 1, land.row + 1, land.column)[side])
        length = float(np.hypot(*(end - start)))
        way = (end - start) / length
        outward = self.city.heading(start, -inward)
        meshes, at = [], CORNER_M + 3.0
        lamp_next = bool(rng.random() < 0.5)
        while at < length - CORNER_M - 3:
            point = start + way * at + inward * 0.75
            if lamp_next:
                meshes.append(self._put(self.furniture.lamp, point, outward))
            elif street.trees and rng.random() < 0.8:
                kind = (street.index * 5 + side * 3 + int(rng.integers(3))) % TREE_KINDS
                meshes.append(self._put(self.furniture.trees[kind], point, rng.uniform(0, 6.3)))
            elif rng.random() < 0.5:
                sign = self.furniture.signs[int(rng.integers(6))]
                meshes.append(self._put(sign, point, self.city.heading(point, -way)))
            if rng.random() < 0.3:
                extra = self.furniture.small[int(rng.integers(3))]
                meshes.append(self._put(extra, point + way * rng.uniform(1.5, 3), outward + np.pi))
            lamp_next = not lamp_next if rng.random() < 0.6 else False
            at += rng.uniform(6.5, 9.5)
        if rng.random() < 0.25:
            spot = start + way * length * rng.uniform(0.3, 0.7) + inward * 1.9
            meshes.append(self._put(self.furniture.shelter, spot, outward))
        return meshes

    def _put(self, template: MeshTemplate, point: Array, yaw: float) -> PlacedMesh:
        x, y = self.city.bend(point)
        return template.placed((float(x), float(y), KERB_M), yaw)


def _house_meshes(house: House) -> list[PlacedMesh]:
    wall = joined([w.mesh for w in house.walls])
    rows = np.stack([w.row for w in house.walls])
    index = np.repeat(np.arange(len(rows)), [len(w.mesh.faces) for w in house.walls]).astype(np.int32)
    return [PlacedMesh.from_mesh(wall, index, rows), PlacedMesh.from_mesh(joined(house.rest))]


def signal_meshes(
    city: CityPlan, signals: Signals, furniture: StreetFurniture, here: ArrayLike, time_s: float
) -> list[PlacedMesh]:
    """Traffic signals around a world point (2,), with their lights at a time in seconds.

    Each junction has one signal for each approach, behind the junction on the right.
    """
    x, y = city.unbend(here)
    reach = SIGNALS_REACH_M
    meshes = []
    for column in city.streets_between(1, x - reach, x + reach):
        for row in city.streets_between(0, y - reach, y + reach):
            node = (column.index, row.index)
            for direction in range(4):
                street, cross = street_of(city, node, direction), street_of(city, node, direction + 1)
                ahead = DIRECTIONS[direction] * (cross.half_width + 0.9)
                spot = node_center(city, node) + ahead + right_of(direction) * (street.half_width + 0.9)
                template = furniture.signals[signals.light(node, direction % 2, time_s)]
                yaw = city.heading(spot, -DIRECTIONS[direction])
                px, py = city.bend(spot)
                meshes.append(template.placed((float(px), float(py), KERB_M), yaw))
    return meshes
