"""The rendered drives of `odometry_accuracy.py`.

    python tests/tools/odometry_drives.py OUT [--only NAME…] [--body moving]

Twenty seeds with five rigs at 2 Hz, among them night, rain, standing, reversing and sharp turns; two hard drives; and
two with a body that moves. Seeds from 1,065,000 on; `bevcli render` draws no rain, no night and no reversing.
"""

import argparse
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera, CameraRig, Distortion, default_ego_from_bev
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.printing import say
from bevcli.workshop.synth import Body
from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.corruptions import blur_kernel, low_light, to_uint8
from bevcli.workshop.synth.drive import FIRST_TIMESTAMP_NS, RenderedDrive, RenderedFrame, export_drive
from bevcli.workshop.synth.rig import EGO_AXES_FROM_CAMERA, DrawnRig, RigDistribution, draw_rig, nuscenes_like_rig

FRAMES, RATE_HZ = 12, 2.0
SIMULATED = 40  # frames; a drive is a part of them
Image = NDArray[np.uint8]
Way = Callable[[float], float]  # seconds since the start of the drive -> those of the simulated vehicle


@dataclass(frozen=True)
class Plan:
    """One drive.

    Attributes:
        name: of its folder; the part before the first "-" is the rig.
        seed: of the street.
        first: frame of the simulation at which the drive begins.
        tempo: factor of all speeds; negative: time runs backwards.
        way: of the vehicle along its path; the traffic does not follow it.
        weather: None for that of the seed.
        look: "", "night", "rain", "bonnet" (a part of each image that never moves) or "black" (four black frames).
        sway_deg: largest pitch of the vehicle; it rolls by half of it.
        body: of the vehicle; its motion follows the simulation.
    """

    name: str
    seed: int
    first: int
    tempo: float = 1.0
    way: Way = float
    weather: str | None = None
    look: str = ""
    sway_deg: float = 0.0
    body: Body = "still"


def _there_and_back(time_s: float) -> float:
    """Forward for 2 s, and back from 3 s on."""
    return time_s if time_s < 2 else 2.5 - (time_s - 3) ** 2 / 2 if time_s < 3.5 else 2.375 - (time_s - 3.5) / 2


PLANS = (
    Plan("six-turn", 1065000, 0),
    Plan("six-night", 1065018, 24, look="night"),
    Plan("six-rain", 1065007, 0, look="rain", sway_deg=0.5),
    Plan("six-sharp", 1065030, 0, tempo=2.0),
    Plan("front-fast", 1065029, 0),
    Plan("front-stop", 1065009, 2, look="bonnet"),
    Plan("front-reverse", 1065015, 20, way=_there_and_back),
    Plan("front-night", 1065027, 26, look="night"),
    Plan("stereo-turn", 1065008, 9),
    Plan("stereo-rain", 1065012, 6, look="rain"),
    Plan("stereo-start", 1065025, 13, weather="noon"),
    Plan("stereo-sharp", 1065019, 4, tempo=2.0),
    Plan("fisheye-turn", 1065014, 4),
    Plan("fisheye-reverse", 1065024, 16, tempo=-1.0),
    Plan("fisheye-night", 1065013, 7, look="night"),
    Plan("fisheye-rain", 1065021, 17, look="rain", sway_deg=0.5),
    Plan("random-turn", 1065026, 18),
    Plan("random-sway", 1065016, 17, sway_deg=0.5),
    Plan("random-night", 1065002, 20, look="night"),
    Plan("random-stop", 1065023, 2),
    # Not among the twenty.
    Plan("hard-black", 1065011, 0, look="black"),
    Plan("hard-queue", 1065028, 1, weather="noon"),
    Plan("six-body", 1065030, 0, body="moving"),
    Plan("front-body", 1065009, 2, body="moving"),
)


class PlannedDrive(RenderedDrive):
    """The rendered drive of a plan."""

    def __init__(self, plan: Plan, assets: Assets) -> None:
        drawn = replace(rig_of(plan), body=plan.body)
        samples = 2 if max(camera.width for camera in drawn.rig.cameras) <= 1000 else 1
        super().__init__(plan.seed, SIMULATED, RATE_HZ, drawn, plan.weather, assets, supersampling=samples)
        self.frames, self._plan = FRAMES, plan

    def time_s(self, index: int) -> float:
        """Time of a frame in the simulation, seconds."""
        return (self._plan.first + self._plan.tempo * index) / self.rate_hz

    def world_from_ego(self, time_s: float) -> Pose:
        """Pose of the ego vehicle at a time in the simulation, seconds."""
        begin, sway = self.time_s(0), np.radians(self._plan.sway_deg)
        passed = time_s - begin
        (x, y), yaw = self.simulation.ego.pose(begin + self._plan.way(passed))
        tilt = cv2.Rodrigues(sway * np.array([0.5 * np.sin(3.1 * passed), np.sin(4.3 * passed + 1), 0]))[0]
        world_from_body = rigid((x, y, 0.0), rotation_about_z(yaw) @ tilt)
        if self._body is not None:
            world_from_body = world_from_body @ self._body.level_from_body(time_s)
        return Pose.from_matrix(world_from_body)

    def ego_motion(self, rate_hz: float = 50.0) -> EgoMotion:
        """Poses and kinematics of the drive, `rate_hz` per second."""
        last_s = (self.frames - 1) / self.rate_hz + max(self._delays_s.values(), default=0.0)
        times = np.arange(int(np.ceil(last_s * rate_hz)) + 1) / rate_hz
        poses = [self.world_from_ego(self.time_s(0) + self._plan.tempo * float(t)) for t in times]
        stamps = FIRST_TIMESTAMP_NS + np.round(times * 1e9).astype(np.int64)
        table = stamps, np.stack([p.translation for p in poses]), np.stack([p.quaternion for p in poses])
        return EgoMotion(*table, *derive_kinematics(*table))

    def frame(self, index: int) -> RenderedFrame:
        """Render a frame."""
        frame, tempo = super().frame(index), self._plan.tempo
        views = {
            name: replace(view, pixels_bgr=looked_at(view.pixels_bgr, self._plan, name, index))
            for name, view in frame.views.items()
        }
        velocities = None if frame.boxes.velocities is None else tempo * frame.boxes.velocities
        return replace(frame, views=views, boxes=replace(frame.boxes, velocities=velocities))


def rig_of(plan: Plan) -> DrawnRig:
    """The rig of a plan."""
    kind = plan.name.split("-")[0]
    if kind in ("six", "hard"):
        return DrawnRig(nuscenes_like_rig())
    if kind == "random":
        return draw_rig(RigDistribution(random_share=1.0, distorted_share=0.5), plan.seed, (1000, 562))
    if kind == "front":
        cameras = [_pinhole("CAM_FRONT", (1280, 720), 1000.0, (1.7, 0.0, 1.45), 2.0)]
    elif kind == "stereo":
        cameras = [_pinhole(f"CAM_{n}", (1242, 375), 721.5, (1.68, y, 1.65), 0) for n, y in _STEREO]
    else:
        cameras = [_fisheye(*mount) for mount in _FISHEYES]
    return DrawnRig(CameraRig(tuple(cameras), default_ego_from_bev()))


_STEREO = ("LEFT", 0.27), ("RIGHT", -0.27)
_FISHEYES = (
    ("CAM_FRONT", (3.6, 0.0, 0.8), 0.0, 15.0),
    ("CAM_LEFT", (1.9, 1.0, 1.0), 90.0, 30.0),
    ("CAM_BACK", (-1.0, 0.0, 0.9), 180.0, 15.0),
    ("CAM_RIGHT", (1.9, -1.0, 1.0), -90.0, 30.0),
)  # name, position in metres, yaw and pitch down in degrees


def _mounted(position: tuple[float, float, float], yaw_deg: float, down_deg: float) -> NDArray[np.float64]:
    down = cv2.Rodrigues(np.array([0.0, np.radians(down_deg), 0.0]))[0]
    return rigid(position, rotation_about_z(np.radians(yaw_deg)) @ down @ EGO_AXES_FROM_CAMERA)


def _pinhole(
    name: str, size: tuple[int, int], focal: float, position: tuple[float, float, float], down_deg: float
) -> Camera:
    intrinsics = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    return Camera(name, *size, intrinsics, _mounted(position, 0, down_deg))


def _fisheye(name: str, position: tuple[float, float, float], yaw_deg: float, down_deg: float) -> Camera:
    """About 180° across 1000 pixels."""
    intrinsics = np.array([[315.0, 0, 500], [0, 315.0, 375], [0, 0, 1.0]])
    lens = Distortion("kannala_brandt", (0.01, -0.005, 0.0, 0.0))
    return Camera(name, 1000, 750, intrinsics, _mounted(position, yaw_deg, down_deg), lens)


def looked_at(pixels: Image, plan: Plan, name: str, index: int) -> Image:
    """The image of a camera with the look of the plan."""
    camera = sum(map(ord, name))
    random = np.random.default_rng([plan.seed, camera, index])
    if plan.look == "night":
        return low_light(pixels, 1, random)
    if plan.look == "rain":
        return _rain(pixels, random, np.random.default_rng([plan.seed, camera]))
    if plan.look == "bonnet":
        return _bonnet(pixels)
    if plan.look == "black" and 4 <= index < 8:
        return np.clip(random.normal(2, 1.2, pixels.shape), 0, 255).astype(np.uint8)
    return pixels


def _rain(pixels: Image, random: np.random.Generator, of_lens: np.random.Generator) -> Image:
    """Grey light, streaks that differ from frame to frame, and drops on the lens that stay."""
    height, width = pixels.shape[:2]
    values = pixels.astype(np.float32) / 255
    values = 0.12 + 0.62 * (values.mean(-1, keepdims=True) * 0.4 + values * 0.6)
    seeds = (random.random((height, width)) < 0.0012).astype(np.float32)
    kernel = blur_kernel(24, 12.0, random.uniform(80, 100), width / 1600)
    values += (1.6 * cv2.filter2D(seeds, -1, kernel, borderType=cv2.BORDER_REFLECT))[..., None]
    drops = np.zeros((height, width), np.float32)
    for _ in range(12):
        at = (int(of_lens.uniform(0, width)), int(of_lens.uniform(0, height)))
        cv2.circle(drops, at, int(width * of_lens.uniform(0.006, 0.022)), 1.0, -1)
    drops = cv2.GaussianBlur(drops, (0, 0), width / 400)[..., None]
    seen = cv2.GaussianBlur(values, (0, 0), width / 90)
    return to_uint8(values * (1 - drops) + drops * (seen + 0.05))


def _bonnet(pixels: Image) -> Image:
    """A vehicle's own bonnet at the lower edge of the image, with a highlight."""
    height, width = pixels.shape[:2]
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(0, 1, height))
    edge = 0.84 + 0.16 * x**2
    shade = (40 + 90 * np.exp(-(((y - edge - 0.05) / 0.02) ** 2)) + 25 * np.cos(9 * x))[..., None]
    return np.where((y > edge)[..., None], shade.clip(0, 255), pixels).astype(np.uint8)


def main() -> None:
    """Render the drives that are not there yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", default=[], help="parts of names")
    parser.add_argument("--body", choices=("still", "moving"), help="of all drives, instead of their own")
    given = parser.parse_args()
    assets = Assets.build()
    for plan in PLANS:
        folder = given.out / plan.name
        if folder.exists() or (given.only and not any(part in plan.name for part in given.only)):
            continue
        unfinished = folder.with_suffix(".unfinished")
        shutil.rmtree(unfinished, ignore_errors=True)
        export_drive(PlannedDrive(replace(plan, body=given.body or plan.body), assets), unfinished)
        unfinished.rename(folder)
        say(f"{folder}: seed {plan.seed}")


if __name__ == "__main__":
    main()
