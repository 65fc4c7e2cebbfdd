"""A rendered drive: its frames, ground truth and ego-motion, in memory or as a sequence folder.

`render` makes a drive and writes it, `export_drive` writes a given one.
"""

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lsim

from bevcli.frame import BevMap, CameraImage, DriveFacts, Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array, Pose, apply, inverse, rigid, rotation_about_z
from bevcli.options import gather
from bevcli.parsing.images import encode_image
from bevcli.workshop.formats.map_lines import MapLines
from bevcli.workshop.formats.output import NativeWriter, write_ego_motion
from bevcli.workshop.synth import JPEG_QUALITY, RenderOptions
from bevcli.workshop.synth.catalog import Assets, Body
from bevcli.workshop.synth.city import CityPlan
from bevcli.workshop.synth.ground import GroundPlan, GroundTexture, draw_map, paint_ground, true_lines
from bevcli.workshop.synth.material import Coats, MaterialFolder, PhotoLooks
from bevcli.workshop.synth.mesh import TriangleSoup
from bevcli.workshop.synth.renderer import RenderedView, ShadowMap, WorldSnapshot, render_through_lens, render_view
from bevcli.workshop.synth.rig import DrawnRig, lens_parts, nuscenes_like_rig, rig_for_rendering, tilt
from bevcli.workshop.synth.scenery import WEATHER_NAMES, Looks, Scenery, make_weather
from bevcli.workshop.synth.simulation import Actor, Density, Simulation, draw_density
from bevcli.workshop.synth.traffic import ActorState, EgoTrack

MOST_DEG = (1.5, 1.0)  # pitch and roll
MOST_HEAVE_M = 0.03
MIDDLE = np.array([1.4, 0.0, 0.0])  # of the turn, in the ego frame, metres
STEP_S = 0.01
SPRING_HZ, DAMPING = 1.3, 0.35
NOD_DEG, LEAN_DEG = (0.12, 0.30), (0.15, 0.35)  # of pitch and roll for each m/s², lowest and highest of the vehicles
LOAD_DEG = (0.4, 0.25)  # standard deviations
WAVES_M = (5, 200, 12)  # shortest and longest wave of the road, and their number
SHORT_M = 25.0  # waves that are shorter come of an uneven road, longer ones of its slopes and crowns
UNEVEN_DEG, SLOPE_DEG = 0.1, 0.2  # standard deviations of each wave
UNEVEN_M = 0.004  # the same of the heave


@dataclass(frozen=True)
class BodyMotion:
    """Tilt and heave of the body at times after the start of a drive, over a vehicle that stands on a level road."""

    times: Array  # (T,) seconds
    turns: Array  # (T, 2) pitch, positive with the nose down, and roll, positive with the right side down; radians
    heaves: Array  # (T,) metres

    @staticmethod
    def draw(ego: EgoTrack, random: np.random.Generator) -> "BodyMotion":
        """The motion of a vehicle on its way, with springs, a load and a road that are drawn at random."""
        times = np.arange(ego.track[0, 0], ego.track[0, -1], STEP_S)
        way, speeds = (np.interp(times, ego.track[0], row) for row in ego.track[1:])
        gains = [random.uniform(*range_deg) for range_deg in (NOD_DEG, LEAN_DEG)]
        forward, left = np.gradient(speeds, STEP_S), speeds * np.gradient(ego.route.yaw_at(way), STEP_S)
        own = 2 * np.pi * SPRING_HZ
        spring = ([own**2], [1, 2 * DAMPING * own, own**2])
        swings = [lsim(spring, pull, times - times[0])[1] for pull in (-gains[0] * forward, gains[1] * left)]
        lengths, roughness = np.geomspace(*WAVES_M), random.uniform(0.3, 1.3)
        waves = np.sin(2 * np.pi * (way[:, None, None] / lengths + random.random((3, len(lengths)))))  # (T, 3, waves)
        heights_deg = np.sqrt(2) * roughness * np.where(lengths < SHORT_M, UNEVEN_DEG, SLOPE_DEG)
        turns_deg = np.stack(swings, -1) + random.normal(0, LOAD_DEG) + waves[:, :2] @ heights_deg
        turns = np.radians(MOST_DEG * np.tanh(turns_deg / MOST_DEG))
        heaves = waves[:, 2] @ np.full(len(lengths), UNEVEN_M * roughness)
        return BodyMotion(times, turns, MOST_HEAVE_M * np.tanh(heaves / MOST_HEAVE_M))

    def level_from_body(self, time_s: float) -> Array:
        """(4, 4) from the ego frame to that of the vehicle on a level road with its springs at rest, metres."""
        pitch, roll, heave = (np.interp(time_s, self.times, x) for x in (*self.turns.T, self.heaves))
        turn = tilt(pitch, roll)
        return rigid(MIDDLE + (0, 0, heave)) @ rigid(-turn @ MIDDLE, turn)


ANNOTATED_M = 60.0  # boxes are kept within this distance of the origin of the bev frame
ACTORS_M = 66.0  # actors are drawn within this distance
SCENERY_M = 135.0  # scenery is drawn within this distance
NEAR_GROUND_M = 112.0  # side of the square that the ground texture and the shadow map cover at least
SNAP_M = 24.0  # scenery, ground and shadows are made again when the vehicle has moved about this far
TEXELS_M = {500: (0.125, 0.16), 1000: (0.06, 0.08), np.inf: (0.04, 0.06)}  # largest width -> of ground and shadows
FIRST_TIMESTAMP_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class RenderedFrame:
    """One frame of a rendered drive with its ground truth."""

    stamp: FrameStamp
    views: Mapping[str, RenderedView]  # by camera
    world_from_ego: Pose
    world_from_ego_at: Mapping[str, Pose]  # by camera, at the time of its image
    camera_timestamps_ns: Mapping[str, int]  # by camera
    boxes: Boxes3D  # world frame, with attributes, instances, visibilities, pixels
    bev_map: BevMap
    lines: MapLines  # bev frame

    @property
    def images(self) -> dict[str, NDArray[np.uint8]]:
        """Camera name to image (H, W, 3) uint8 BGR."""
        return {name: view.pixels_bgr for name, view in self.views.items()}


class RenderedDrive:
    """A drive through the city of one seed.

    `frame(k)` renders any frame, in any order; the same seed and options always give the same frames.

    Args:
        seed: the drive; 0 or greater.
        frames: number of frames.
        rate_hz: frames per second.
        rig: the cameras, or a drawn rig with delays of its cameras (0 to 0.1 s), the motion of the vehicle's body,
            whether the looks are varied (`Looks`), and their material; default: `nuscenes_like_rig` at 400x225.
        weather: one of WEATHER_NAMES; default: drawn from the seed.
        assets: the meshes, if they are built already.
        supersampling: samples per pixel along each axis (anti-aliasing).
        threads: number of cameras rendered in parallel.
        map_half_extent_m: from the origin of the bev frame to each side of the ground truth maps, metres.
    """

    def __init__(
        self,
        seed: int,
        frames: int = 20,
        rate_hz: float = 2.0,
        rig: CameraRig | DrawnRig | None = None,
        weather: str | None = None,
        assets: Assets | None = None,
        supersampling: int = 1,
        threads: int = 1,
        map_half_extent_m: float = 32.0,
    ) -> None:
        self.seed, self.frames, self.rate_hz = seed, frames, rate_hz
        drawn = rig if isinstance(rig, DrawnRig) else DrawnRig(rig or nuscenes_like_rig(400, 225))
        self.rig, self._delays_s = drawn.rig, drawn.delays_s
        self._looks = Looks(seed) if drawn.varied else None
        self._lenses = {camera.name: lens_parts(camera) for camera in self.rig.cameras if camera.distortion}
        self._map_half_extent_m = map_half_extent_m
        self._supersampling, self._threads = supersampling, threads
        self._assets, density = assets or Assets.build(), Density()
        self._photo: PhotoLooks | None = None
        self._city = CityPlan(seed)
        names = self._city.stream("weather-name")
        name = weather or WEATHER_NAMES[int(names.choice(3, p=[0.45, 0.25, 0.3]))]
        self.weather = make_weather(name, self._city.stream("weather"))
        if self._looks is not None:
            self.weather = self._looks.weather(self.weather)
            if drawn.material:
                material, density = MaterialFolder.read(drawn.material), draw_density(self._looks.stream("density"))
                self._assets = replace(self._assets, models=material.models)
                self._photo = PhotoLooks.draw(self._looks, material, self.weather)
                self.weather = self._photo.weather
        self.simulation = Simulation(self._city, self._assets, frames / rate_hz, density)
        stream, self._is_stated = self._city.stream("body"), drawn.body != "unstated"
        self._body = None if drawn.body == "still" else BodyMotion.draw(self.simulation.ego, stream)
        self._ground = GroundPlan(self._city)
        width = max(camera.width for camera in self.rig.cameras) * supersampling
        self._texels_m = next(sizes for most, sizes in TEXELS_M.items() if width <= most)
        self._scenery = Scenery(self._city, self._assets.furniture, self._looks)
        self._around = lru_cache(maxsize=1)(self._make_surroundings)
        self._template = lru_cache(maxsize=None)(self._make_template)
        self._placed = lru_cache(maxsize=500)(self._make_placed)  # an actor that stands still is placed once

    def time_s(self, index: int) -> float:
        """Time of a frame, seconds since the start of the drive."""
        return index / self.rate_hz

    def world_from_ego(self, time_s: float) -> Pose:
        """Pose of the ego vehicle, seconds after the start of the drive."""
        (x, y), yaw = self.simulation.ego.pose(time_s)
        pose = rigid((x, y, 0.0), rotation_about_z(yaw))
        return Pose.from_matrix(pose if self._body is None else pose @ self._body.level_from_body(time_s))

    def stated_pose(self, time_s: float) -> Pose:
        """The pose that the drive states: `world_from_ego`, without pitch, roll and heave where they are unstated."""
        pose = self.world_from_ego(time_s)
        level = rigid((*pose.translation[:2], 0.0), rotation_about_z(pose.yaw))
        return pose if self._is_stated else Pose.from_matrix(level)

    def ego_motion(self, rate_hz: float = 50.0) -> EgoMotion:
        """Poses and kinematics over the whole drive, `rate_hz` per second."""
        last_s = (self.frames - 1) / self.rate_hz + max(self._delays_s.values(), default=0.0)
        count = int(np.ceil(last_s * rate_hz)) + 1
        times = np.arange(count) / rate_hz
        poses = [self.stated_pose(float(t)) for t in times]
        stamps = FIRST_TIMESTAMP_NS + np.round(times * 1e9).astype(np.int64)
        table = stamps, np.stack([p.translation for p in poses]), np.stack([p.quaternion for p in poses])
        if self._body is not None and self._is_stated:
            return EgoMotion(*table, *derive_kinematics(*table))
        motions = [self.simulation.ego.motion(float(t)) for t in times]
        return EgoMotion(*table, *(np.stack([m[k] for m in motions]) for k in range(3)))

    def _actors(self, index: int) -> list[tuple[Actor, ActorState]]:
        origin = self.world_from_ego(self.time_s(index)).translation[:2]
        seen = ((actor, actor.state(self.time_s(index))) for actor in self.simulation.actors_near(origin, ACTORS_M))
        return [(a, state) for a, state in seen if state and np.hypot(*(state.position[:2] - origin)) < ACTORS_M]

    def frame(self, index: int) -> RenderedFrame:
        """Render a frame. index: 0 to frames - 1."""
        actors, time_s = self._actors(index), self.time_s(index)
        timestamp_ns = FIRST_TIMESTAMP_NS + round(index * 1e9 / self.rate_hz)
        stamp = FrameStamp(index, f"rendered-{self.seed}", timestamp_ns)
        states = [state for _, state in actors]
        pose = self.stated_pose(time_s)
        delays = {name: self._delays_s.get(name, 0.0) for name in self.rig.names}
        views: dict[str, RenderedView] = {}
        for delay in sorted(set(delays.values())):
            later = [actor.state(time_s + delay) for actor, _ in actors] if delay else states
            # An object that has gone in the meantime is drawn where it was.
            seen = [state if moved is None else moved for state, moved in zip(states, later, strict=True)]
            names = [name for name in self.rig.names if delays[name] == delay]
            there = self.world_from_ego(time_s + delay)
            views |= self._render_views(names, seen, there, time_s + delay, pose.translation[:2])
        views = {name: views[name] for name in self.rig.names}
        boxes = self._boxes(states, views, pose)
        bev_from_world = inverse(pose.matrix @ self.rig.ego_from_bev)
        pieces = self._ground.pieces_around(pose.translation[:2], self._map_half_extent_m * 1.5)
        bev_map = draw_map(pieces, boxes, bev_from_world, self._map_half_extent_m)
        poses = {name: self.stated_pose(time_s + delay) for name, delay in delays.items()}
        times = {name: timestamp_ns + round(delay * 1e9) for name, delay in delays.items()}
        return RenderedFrame(stamp, views, pose, poses, times, boxes, bev_map, true_lines(pieces, bev_from_world))

    def _render_views(
        self, names: list[str], states: list[ActorState], world_from_ego: Pose, time_s: float, here: Array
    ) -> dict[str, RenderedView]:
        """The images of cameras that see the world at the same time. The object indices are positions in `states`.

        here: (2,) world, metres, the point around which the scenery is made.
        """
        # Those of the nearest point of a grid with SNAP_M spacing, so that they are rarely made again.
        scenery, ground, shadows, coats = self._around(*(float(np.round(at / SNAP_M) * SNAP_M) for at in here))
        near_first = np.argsort([np.hypot(*(state.position[:2] - here)) for state in states], kind="stable")
        near = [states[k] for k in near_first]
        actors = [self._placed(state.body, state.pose, *state.position.tolist(), state.yaw) for state in near]
        signals = list(self._scenery.signals_around(here, self.simulation.signals, time_s))
        moving = TriangleSoup.gather([*actors, *signals], [*near_first.tolist(), *[-1] * len(signals)])
        x, y, _ = apply(world_from_ego.matrix, MIDDLE)
        vehicle = self._placed(self.simulation.ego_body, 0, x, y, 0.0, world_from_ego.yaw)
        shadows = shadows.with_shadows_of([moving.corners, vehicle.corners])
        soup = TriangleSoup.gather([scenery, moving])
        snapshot = WorldSnapshot(soup, len(actors), ground, shadows, self.weather)
        if self._looks is not None:
            snapshot = replace(snapshot, pattern=self._looks.pattern())
        if self._photo is not None and coats is not None:
            ego, size = apply(world_from_ego.matrix, MIDDLE), self.simulation.ego_body.size_lwh
            placed = [(state.position, state.yaw, state.body.size_lwh) for state in states]
            placed.append((ego, world_from_ego.yaw, size))
            strength, waves, hardness = snapshot.pattern
            pattern = (strength * self._photo.pattern_share, waves, hardness)
            snapshot = replace(snapshot, pattern=pattern, photo=self._photo.view(coats, placed, here))

        def render_one(name: str) -> RenderedView:
            pose = world_from_ego.matrix
            if name in self._lenses:
                return render_through_lens(snapshot, self._lenses[name], pose, self._supersampling)
            return render_view(snapshot, self.rig[name], pose, self._supersampling)

        if self._threads == 1:
            return {name: render_one(name) for name in names}
        with ThreadPoolExecutor(self._threads) as pool:
            return dict(zip(names, pool.map(render_one, names), strict=True))

    def _make_surroundings(self, x: float, y: float) -> tuple[TriangleSoup, GroundTexture, ShadowMap, Coats | None]:
        center, extent, (ground_m, shadow_m) = (x, y), NEAR_GROUND_M + SNAP_M, self._texels_m
        texture = paint_ground(self._ground.pieces_around(center, extent * 0.71), center, extent, ground_m)
        coats: Coats | None = None
        reach_m = SCENERY_M if self._photo is None else min(SCENERY_M, self._photo.scenery_m)
        scenery = self._scenery.around(center, reach_m)
        if self._looks is not None:
            texture = replace(texture, texels=self._looks.ground(texture.texels))
            scenery = self._looks.scenery(scenery)
        if self._photo is not None:
            scenery, coats = self._photo.coated(scenery)
        shadows = ShadowMap.of(scenery.corners, self.weather.to_sun, center, extent, shadow_m)
        return scenery, texture, shadows, coats

    def _make_placed(self, body: Body, pose: int, x: float, y: float, z: float, yaw: float) -> TriangleSoup:
        return self._template(body, pose).placed((x, y, z), yaw)

    def _make_template(self, body: Body, pose: int) -> TriangleSoup:
        mesh, paint = body.variant.poses[pose % len(body.variant.poses)], body.paint
        if self._looks is not None:
            mesh = self._looks.body(mesh, body.instance, recolour=not body.variant.shaded)
            paint = self._looks.paint(paint, body.instance)
        return TriangleSoup.from_mesh(mesh.fitted(body.size_lwh)).painted(paint, body.dye, body.variant.shaded)

    def _boxes(self, states: list[ActorState], views: Mapping[str, RenderedView], pose: Pose) -> Boxes3D:
        """Ground truth boxes in the world frame, within ANNOTATED_M of the origin of the bev frame."""
        if not states:
            return Boxes3D.empty()
        visible = sum(view.visible for view in views.values())
        unoccluded = sum(view.unoccluded for view in views.values())
        sizes = np.stack([s.body.size_lwh for s in states])
        centers = np.stack([s.position for s in states])
        centers[:, 2] += sizes[:, 2] / 2
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


EGO_MOTION_HZ = 50.0
SUPERSAMPLED_WIDTH = 1000  # images up to this width are supersampled by default
THREADS = 2
# Of the boxes that are written, in m, radians, m/s: they keep the files small.
DECIMALS = {"centers": 4, "sizes_lwh": 4, "yaws": 5, "velocities": 4, "visibilities": 4}


@dataclass(frozen=True)
class RenderSummary:
    """Summary of the sequence that `render` has written."""

    folder: Path  # the sequence folder
    seed: int  # of the drive
    frames: int  # number of frames
    cameras: tuple[str, ...]  # their names
    weather: str  # name of the weather


def render(out: str | Path, options: RenderOptions | None = None, **changes: Any) -> RenderSummary:
    """Render a drive through a procedural city and write it as a sequence with ground truth boxes and maps.

    The same options give the same files. The models of this project were trained on seeds below 1,000,000 only. The
    first call on a computer compiles the renderer, which takes about 15 s.

    Args:
        out: the sequence folder to write.
        options: the options; by default those of `RenderOptions`.
        changes: options by name, such as `seed=7` and `resolution=(800, 450)`.

    Raises:
        InputError: an option is out of range, the calibration file is wrong, or a camera's field of view is too wide.
        OutputError: `out` contains a sequence and `force` is false, or it cannot be written.
    """
    chosen = gather(RenderOptions, options, changes)
    drive = drive_of(chosen)
    export_drive(drive, Path(out), force=chosen.force, quality=chosen.quality)
    return RenderSummary(Path(out), chosen.seed, chosen.frames, drive.rig.names, drive.weather.name)


def drive_of(options: RenderOptions) -> RenderedDrive:
    """The drive that `render` writes. Raises InputError as it does."""
    rig = rig_for_rendering(options.rig, options.resolution)
    samples = options.supersampling or (2 if max(c.width for c in rig.cameras) <= SUPERSAMPLED_WIDTH else 1)
    drawn = DrawnRig(rig, body=options.body)
    return RenderedDrive(
        options.seed, options.frames, options.rate_hz, drawn, options.weather, supersampling=samples, threads=THREADS
    )


def export_drive(drive: RenderedDrive, folder: Path, *, force: bool = False, quality: int = JPEG_QUALITY) -> None:
    """Render all frames of a drive and write them; see `export_frames`."""
    for _ in export_frames(drive, folder, force=force, quality=quality):
        pass


def export_frames(
    drive: RenderedDrive, folder: Path, *, force: bool = False, quality: int = JPEG_QUALITY
) -> Iterator[Frame]:
    """Render the frames of a drive, with ground truth boxes and maps, and write them; each when it is written.

    At the end the ego-motion is written at EGO_MOTION_HZ.
    folder: the sequence folder. force: whether to replace a sequence in it. quality: JPEG quality, 1 to 100.
    Raises OutputError where the folder contains a sequence and `force` is false, or cannot be written.
    """
    with NativeWriter(folder, with_ego_motion=True, force=force, facts=DriveFacts(rendered=True)) as writer:
        motion = drive.ego_motion(EGO_MOTION_HZ)
        for rendered in map(drive.frame, range(drive.frames)):
            images = {}
            for name, pixels in rendered.images.items():
                encoded = encode_image(pixels, quality=quality)
                images[name] = CameraImage(rendered.camera_timestamps_ns[name], pixels, encoded, "image/jpeg")
            values: dict[str, Any] = {name: getattr(rendered.boxes, name) for name in DECIMALS}
            rounded = {name: np.round(v, DECIMALS[name]) for name, v in values.items() if v is not None}
            frame = Frame(
                rendered.stamp, drive.rig, images, rendered.world_from_ego, rendered.world_from_ego_at,
                motion.kinematics_at(rendered.stamp.timestamp_ns), ground_truth=replace(rendered.boxes, **rounded),
                ground_truth_map=rendered.bev_map, ground_truth_results=(rendered.lines,),
            )  # fmt: skip
            writer.write(frame)
            yield frame
    # The writer has written a pose for each frame. Replace them by denser ones, so that cameras may have time offsets.
    write_ego_motion(folder / "ego_motion.csv", motion)
