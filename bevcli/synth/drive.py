"""Drive: one seed's drive through the rendered world, frame by frame, without touching the disk."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import BevMap, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Array, Pose, apply, inverse, rigid, rotation_about_z
from bevcli.synth.assets.catalog import Catalog
from bevcli.synth.bev_truth import MapWindow, draw_map
from bevcli.synth.render.ground_texture import GroundTexture, paint_ground
from bevcli.synth.render.renderer import Exposure, Moment, expose
from bevcli.synth.render.shading import ShadowMap
from bevcli.synth.render.shadows import shadow_map, with_more
from bevcli.synth.render.triangles import Run, Shape, Soup, gather, joined_soup, place
from bevcli.synth.rig import nuscenes_like_rig
from bevcli.synth.world.actors import Actor, Body, State
from bevcli.synth.world.city import CityPlan
from bevcli.synth.world.ground_plan import GroundPlan
from bevcli.synth.world.scenery import Furnishings, Scenery
from bevcli.synth.world.simulation import Simulation
from bevcli.synth.world.street_signals import signal_runs
from bevcli.synth.world.weather import WEATHER_NAMES, Weather, make_weather

ANNOTATED_M = 60.0  # boxes are kept within this distance of the bev frame's origin
SEEN_M = 66.0  # actors are drawn within this distance
SCENERY_M = 135.0
SNAP_M = 24.0  # scenery and ground are gathered anew when the vehicle has moved this far
FIRST_TIMESTAMP_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Stock:
    """Meshes that all drives share; make it once and hand it to every Drive."""

    catalog: Catalog
    furnishings: Furnishings

    @staticmethod
    def make() -> Stock:
        """Build every mesh, which takes about half a second."""
        return Stock(Catalog(), Furnishings())


@dataclass(frozen=True)
class Detail:
    """How finely ground and shadows are drawn, metres a texel."""

    ground_m: float
    shadow_m: float
    extent_m: float

    @staticmethod
    def for_width(width: int) -> Detail:
        """Detail that suits images of a width in pixels."""
        if width <= 500:
            return Detail(0.125, 0.16, 112.0)
        return Detail(0.06, 0.08, 112.0) if width <= 1000 else Detail(0.04, 0.06, 112.0)


@dataclass(frozen=True)
class Surroundings:
    """What does not move, around a world point: its triangles, the ground's paint, and its shadows."""

    middle: tuple[float, float]
    scenery: Soup
    ground: GroundTexture
    shadows: ShadowMap


@dataclass(frozen=True)
class RenderedFrame:
    """One moment of a drive. exposures: by camera. boxes: in the world frame, with all ground truth columns."""

    stamp: FrameStamp
    exposures: Mapping[str, Exposure]
    world_from_ego: Pose
    boxes: Boxes3D
    bev_map: BevMap

    @property
    def images(self) -> dict[str, NDArray[np.uint8]]:
        """camera -> (H, W, 3) uint8 BGR."""
        return {name: exposure.pixels_bgr for name, exposure in self.exposures.items()}


class Drive:
    """A drive of `frames` frames at `rate_hz`; `frame(k)` renders any of them, in any order, always the same.

    rig: default six cameras like nuScenes' at 400x225. weather: one of WEATHER_NAMES, drawn from the seed by default.
    supersampling: samples a pixel and side, against jagged edges. threads: cameras rendered side by side.
    """

    def __init__(
        self,
        seed: int,
        frames: int = 20,
        rate_hz: float = 2.0,
        rig: CameraRig | None = None,
        weather: str | None = None,
        stock: Stock | None = None,
        supersampling: int = 1,
        threads: int = 1,
        map_window: MapWindow = MapWindow(),
    ) -> None:
        self.seed, self.frames, self.rate_hz = seed, frames, rate_hz
        self.rig = rig or nuscenes_like_rig(400, 225)
        self.scene = f"rendered-{seed}"
        self.map_window = map_window
        self._supersampling, self._threads = supersampling, threads
        self._stock = stock or Stock.make()
        self.city = CityPlan(seed)
        names = self.city.stream("weather-name")
        name = weather or WEATHER_NAMES[int(names.choice(3, p=[0.45, 0.25, 0.3]))]
        self.weather: Weather = make_weather(name, self.city.stream("weather"))
        self.simulation = Simulation(self.city, self._stock.catalog, frames / rate_hz)
        self.ground = GroundPlan(self.city)
        self._detail = Detail.for_width(max(camera.width for camera in self.rig.cameras) * supersampling)
        self._scenery = Scenery(self.city, self._stock.furnishings)
        self._around: Surroundings | None = None
        self._shapes: dict[tuple[str, int], Shape] = {}
        self._placed: dict[tuple[str, int], tuple[Run, tuple[float, ...]]] = {}

    def time_s(self, index: int) -> float:
        """Seconds since the drive's start."""
        return index / self.rate_hz

    def stamp(self, index: int) -> FrameStamp:
        """When a frame is."""
        return FrameStamp(index, self.scene, FIRST_TIMESTAMP_NS + round(index * 1e9 / self.rate_hz))

    def world_from_ego(self, time_s: float) -> Pose:
        """Where the ego vehicle is, seconds after the start."""
        (x, y), yaw = self.simulation.ego.pose(time_s)
        return Pose.from_matrix(rigid((x, y, 0.0), rotation_about_z(yaw)))

    def ego_motion(self, rate_hz: float = 50.0) -> EgoMotion:
        """Poses and kinematics over the whole drive."""
        count = int(np.ceil((self.frames - 1) / self.rate_hz * rate_hz)) + 1
        times = np.arange(count) / rate_hz
        poses = [self.world_from_ego(float(t)) for t in times]
        motions = [self.simulation.ego.motion(float(t)) for t in times]
        return EgoMotion(
            FIRST_TIMESTAMP_NS + np.round(times * 1e9).astype(np.int64),
            np.stack([p.translation for p in poses]), np.stack([p.quaternion for p in poses]),
            *(np.stack([m[k] for m in motions]) for k in range(3)),
        )  # fmt: skip

    def states(self, index: int) -> list[State]:
        """What is annotated around the vehicle at a frame, in the order of the objects in its exposures."""
        origin = self.world_from_ego(self.time_s(index)).translation[:2]
        found = []
        for actor in self._actors(origin):
            state = actor.state(self.time_s(index))
            if state is not None and np.hypot(*(state.position[:2] - origin)) < SEEN_M:
                found.append(state)
        return found

    def frame(self, index: int) -> RenderedFrame:
        """Render one frame, 0 to frames - 1."""
        states = self.states(index)
        pose = self.world_from_ego(self.time_s(index))
        exposures = self.expose(states, pose, self.time_s(index))
        boxes = self._boxes(states, exposures, pose)
        bev_from_world = inverse(pose.matrix @ self.rig.ego_from_bev)
        pieces = self.ground.pieces_around(pose.translation[:2], self.map_window.half_extent_m * 1.5)
        bev_map = draw_map(pieces, boxes, bev_from_world, self.map_window)
        return RenderedFrame(self.stamp(index), exposures, pose, boxes, bev_map)

    def expose(self, states: list[State], world_from_ego: Pose, time_s: float) -> dict[str, Exposure]:
        """The images of all cameras when the annotated world is in these states."""
        around = self._surroundings(world_from_ego.translation[:2])
        here = world_from_ego.translation[:2]
        near_first = np.argsort([np.hypot(*(state.position[:2] - here)) for state in states], kind="stable")
        runs = [self._place(states[k]) for k in near_first]
        signals = signal_runs(self.city, self.simulation.signals, self._stock.furnishings, here, time_s)
        moving = gather([*runs, *signals], [*near_first.tolist(), *[-1] * len(signals)])
        soup = joined_soup(around.scenery, moving)
        shadows = with_more(around.shadows, [moving.surfaces.corners, self._ego_shape(world_from_ego)])
        moment = Moment(soup, len(runs), around.ground, shadows, self.weather)

        def one(name: str) -> Exposure:
            return expose(moment, self.rig[name], world_from_ego.matrix, self._supersampling)

        if self._threads == 1:
            return {name: one(name) for name in self.rig.names}
        with ThreadPoolExecutor(self._threads) as pool:
            return dict(zip(self.rig.names, pool.map(one, self.rig.names), strict=True))

    def _actors(self, origin: Array) -> list[Actor]:
        return self.simulation.actors_near(origin, SEEN_M)

    def _surroundings(self, here: Array) -> Surroundings:
        """Scenery and ground around a point, gathered for the middle of the grid cell that it lies in."""
        middle = (float(np.round(here[0] / SNAP_M) * SNAP_M), float(np.round(here[1] / SNAP_M) * SNAP_M))
        if self._around is None or self._around.middle != middle:
            extent = self._detail.extent_m + SNAP_M
            pieces = self.ground.pieces_around(middle, extent * 0.71)
            texture = paint_ground(pieces, middle, extent, self._detail.ground_m)
            scenery = self._scenery.around(middle, SCENERY_M)
            corners = [scenery.surfaces.corners]
            shadows = shadow_map(corners, self.weather.to_sun, middle, extent, self._detail.shadow_m)
            self._around = Surroundings(middle, scenery, texture, shadows)
        return self._around

    def _place(self, state: State) -> Run:
        """The actor's triangles; those of one that stands still are kept."""
        key = (state.body.instance, state.pose)
        x, y, z = (float(c) for c in state.position)
        here = (x, y, z, state.yaw)
        if key not in self._placed or self._placed[key][1] != here:
            self._placed[key] = (place(self._shape(state.body, state.pose), (x, y, z), state.yaw), here)
        return self._placed[key][0]

    def _shape(self, body: Body, pose: int) -> Shape:
        """The body's mesh in its size and colours."""
        key = (body.instance, pose)
        if key not in self._shapes:
            mesh = body.variant.poses[pose % len(body.variant.poses)].fitted(body.size_lwh)
            self._shapes[key] = Shape.of(mesh).painted(body.paint, body.dye)
        return self._shapes[key]

    def _ego_shape(self, world_from_ego: Pose) -> NDArray[np.float32]:
        """The ego vehicle's own triangles, for its shadow; its frame's origin is behind its middle."""
        x, y, _ = apply(world_from_ego.matrix, (1.4, 0.0, 0.0))
        return place(self._shape(self.simulation.ego_body, 0), (x, y, 0.0), world_from_ego.yaw).corners

    def _boxes(self, states: list[State], exposures: Mapping[str, Exposure], pose: Pose) -> Boxes3D:
        """Ground truth boxes in the world frame, within ANNOTATED_M of the bev frame's origin."""
        if not states:
            return Boxes3D.empty()
        visible = sum(exposure.visible for exposure in exposures.values())
        unoccluded = sum(exposure.unoccluded for exposure in exposures.values())
        sizes = np.stack([s.body.size_lwh for s in states])
        centers = np.stack([s.position for s in states]) + np.column_stack(
            [np.zeros((len(states), 2)), sizes[:, 2] / 2]
        )
        boxes = Boxes3D(
            centers, sizes, np.array([s.yaw for s in states]), np.stack([s.velocity for s in states]),
            np.array([s.body.variant.class_name for s in states]),
            attributes=np.array([s.attribute for s in states]),
            instances=np.array([s.body.instance for s in states]),
            visibilities=np.asarray(visible) / np.maximum(unoccluded, 1),
            num_points=np.asarray(visible).astype(np.int64),
        )  # fmt: skip
        origin = (pose.matrix @ self.rig.ego_from_bev)[:2, 3]
        return boxes[np.hypot(*(boxes.centers[:, :2] - origin).T) < ANNOTATED_M]
