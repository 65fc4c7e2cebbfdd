"""The unannotated world around the vehicle: kerbs, houses, trees and street furniture, block by block."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array
from bevcli.synth.assets.buildings import House, houses, kerb_slab
from bevcli.synth.assets.furniture import (
    bench,
    bin_,
    bus_shelter,
    bush,
    hydrant,
    lamp_post,
    sign_post,
    signal_head,
    tree,
)
from bevcli.synth.assets.mesh import joined
from bevcli.synth.render.triangles import Run, Shape, Soup, gather, make_run, place
from bevcli.synth.world.city import CORNER_M, KERB_M, Block, CityPlan, rounded_rectangle
from bevcli.synth.world.landuse import landuse

TREE_KINDS = 12


class Furnishings:
    """The shapes that scenery repeats, made once."""

    def __init__(self) -> None:
        rng = np.random.Generator(np.random.PCG64(20))
        self.trees = [Shape.of(tree(k, rng)) for k in range(TREE_KINDS)]
        self.bushes = [Shape.of(bush(rng)) for _ in range(4)]
        self.lamp = Shape.of(lamp_post())
        self.signs = [Shape.of(sign_post(k)) for k in range(6)]
        self.small = [Shape.of(mesh) for mesh in (bench(), bin_(), hydrant())]
        self.shelter = Shape.of(bus_shelter())
        self.signals = {light: Shape.of(signal_head(light)) for light in ("red", "yellow", "green")}


class Scenery:
    """All scenery of a city, made block by block when the vehicle comes near."""

    def __init__(self, city: CityPlan, furnishings: Furnishings) -> None:
        self.city, self.furnishings = city, furnishings
        self._blocks: dict[tuple[int, int], list[Run]] = {}

    def around(self, center: ArrayLike, reach_m: float) -> Soup:
        """Runs whose spheres touch a circle around a world point (2,)."""
        x, y = self.city.unbend(center)
        columns = self.city.streets_between(1, x - reach_m, x + reach_m)
        rows = self.city.streets_between(0, y - reach_m, y + reach_m)
        found: list[Run] = []
        for i in range(columns[0].index - 1, columns[-1].index + 1):
            for j in range(rows[0].index - 1, rows[-1].index + 1):
                found += self._block(i, j)
        at = np.asarray(center, dtype=np.float64)
        near = [run for run in found if np.hypot(*(run.sphere[:2] - at)) < reach_m + run.sphere[3]]
        near.sort(key=lambda run: (len(run.facades) == 0, float(np.hypot(*(run.sphere[:2] - at)))))
        return gather(near, [-1] * len(near))  # houses first, near ones before far ones: they hide the most

    def _block(self, column: int, row: int) -> list[Run]:
        key = (column, row)
        if key not in self._blocks:
            self._blocks[key] = self._make(self.city.block(column, row))
        return self._blocks[key]

    def _make(self, land: Block) -> list[Run]:
        slab = kerb_slab(self.city, rounded_rectangle(land.low, land.high, CORNER_M))
        runs = [make_run(slab.faces, slab.albedo, slab.material)]
        use = landuse(self.city, land.column, land.row)
        if use == "houses":
            for house in houses(self.city, land):
                runs += _house_runs(house)
        rng = self.city.stream("furniture", land.column, land.row)
        if use == "park":
            runs += self._park(land, rng)
        for side in range(4):
            runs += self._side(land, side, rng)
        return runs

    def _park(self, land: Block, rng: np.random.Generator) -> list[Run]:
        """Trees and bushes spread over a block."""
        south, east, north, west = land.sidewalks
        low = np.array([land.low[0] + west + 1.5, land.low[1] + south + 1.5])
        high = np.array([land.high[0] - east - 1.5, land.high[1] - north - 1.5])
        count = int(np.prod(high - low) / 75)
        runs = []
        for point in low + rng.random((count, 2)) * (high - low):
            kinds = self.furnishings.trees if rng.random() < 0.7 else self.furnishings.bushes
            runs.append(self._put(kinds[int(rng.integers(len(kinds)))], point, rng.uniform(0, 6.3)))
        return runs

    def _side(self, land: Block, side: int, rng: np.random.Generator) -> list[Run]:
        """One pavement: trees and lamps near the kerb, signs, benches and bins between them."""
        start, end, inward = side_of(land, side)
        street = self.city.street(side % 2, (land.row, land.column + 1, land.row + 1, land.column)[side])
        length = float(np.hypot(*(end - start)))
        way = (end - start) / length
        outward = self.city.heading(start, -inward)
        runs, at = [], CORNER_M + 3.0
        lamp_next = bool(rng.random() < 0.5)
        while at < length - CORNER_M - 3:
            point = start + way * at + inward * 0.75
            if lamp_next:
                runs.append(self._put(self.furnishings.lamp, point, outward))
            elif street.trees and rng.random() < 0.8:
                kind = (street.index * 5 + side * 3 + int(rng.integers(3))) % TREE_KINDS
                runs.append(self._put(self.furnishings.trees[kind], point, rng.uniform(0, 6.3)))
            elif rng.random() < 0.5:
                sign = self.furnishings.signs[int(rng.integers(6))]
                runs.append(self._put(sign, point, self.city.heading(point, -way)))
            if rng.random() < 0.3:
                extra = self.furnishings.small[int(rng.integers(3))]
                runs.append(self._put(extra, point + way * rng.uniform(1.5, 3), outward + np.pi))
            lamp_next = not lamp_next if rng.random() < 0.6 else False
            at += rng.uniform(6.5, 9.5)
        if rng.random() < 0.25:
            spot = start + way * length * rng.uniform(0.3, 0.7) + inward * 1.9
            runs.append(self._put(self.furnishings.shelter, spot, outward))
        return runs

    def _put(self, shape: Shape, point: Array, yaw: float) -> Run:
        x, y = self.city.bend(point)
        return place(shape, (float(x), float(y), KERB_M), yaw)


def side_of(land: Block, side: int) -> tuple[Array, Array, Array]:
    """Start, end and inward direction, each (2,) in plan coordinates, of a block's side: south, east, north, west."""
    (x0, y0), (x1, y1) = land.low, land.high
    corners = [np.array(p, dtype=np.float64) for p in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    inward = np.array([(0, 1), (-1, 0), (0, -1), (1, 0)][side], dtype=np.float64)
    return corners[side], corners[(side + 1) % 4], inward


def _house_runs(house: House) -> list[Run]:
    wall = joined([w.mesh for w in house.walls])
    rows = np.stack([w.row for w in house.walls])
    index = np.repeat(np.arange(len(rows)), [len(w.mesh.faces) for w in house.walls]).astype(np.int32)
    rest = joined(house.rest)
    return [
        make_run(wall.faces, wall.albedo, wall.material, index, rows),
        make_run(rest.faces, rest.albedo, rest.material),
    ]
