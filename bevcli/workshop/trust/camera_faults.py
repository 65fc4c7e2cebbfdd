"""Faults of single cameras: how the points of each camera move in its images, against how the vehicle moves.

One rule: the common mistakes are undone in turn. A camera whose points do not fit the stated poses gets the mistake
after whose undoing they fit. All is measured by points of one camera in successive frames, so that one camera's mistake
does not disturb another one. `bevcli calibrate` measures exactly what is named here.
"""

from collections.abc import Iterator, Mapping, Sequence as Items
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bevcli.errors import Finding
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array, inverse
from bevcli.workshop.correspondence.points import matched
from bevcli.workshop.correspondence.poses import Poses
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry
from bevcli.workshop.odometry.step_views import FrameView

LEAST_M = 0.3  # a shorter step tells nothing
FEWEST = 60  # points of a camera
PARALLAX_PX = 2.0  # a point that moves less has no depth
SCALE_PX = 0.5  # a misfit of one point that counts half
USUAL_SHARE = 0.6  # of points of the middle camera; below it the poses are too inexact to judge single cameras by
LEAST_SHARE = 0.55  # of points that fit after a mistake is undone
EXCHANGED, GAIN, SMALL = 0.2, 0.1, 0.08  # by how much more, if images of two are exchanged; mirrored or late; of others
SURELY = 0.25  # the same of mirrored poses, and of late images where poses are inexact
FLIP = np.diag([1.0, -1.0, 1.0])
COST_GAIN, COST_SHARE = 15.0, 0.05  # of the cost, that undoing a mistake gains; those of sound cameras gain up to 5
TURN, LEAST_TURN_DEG, MOST_TURN_DEG = np.radians(2), 1.0, 15.0  # usual wrong rotation; a told one
LENGTHS, LEAST_LONGER = np.linspace(-0.36, 0.36, 13), 0.05  # logarithms of factors of a focal length; a told one


@dataclass(frozen=True)
class CameraPoints:
    """N matched points of one camera, each in the frames before and after a step."""

    camera: Camera  # of the images
    rays_a: Array  # (N, 3) unit directions in the first frame of the step, camera frame
    rays_b: Array  # (N, 3) in the second one
    times_ns: NDArray[np.int64]  # (N, 2) when both images were taken

    def seen_by(self, camera: Camera) -> "CameraPoints":
        """The points as if another camera had taken the images."""
        rays_a, rays_b = (camera.rays(self.camera.project(each)[0]) for each in (self.rays_a, self.rays_b))
        return CameraPoints(camera, rays_a, rays_b, self.times_ns)

    def mirrored(self) -> "CameraPoints":
        """The points of mirrored images."""
        edge = np.array([self.camera.width - 1, 0])
        pixels = (self.camera.project(each)[0] for each in (self.rays_a, self.rays_b))
        rays_a, rays_b = (self.camera.rays(edge + each * (-1, 1)) for each in pixels)
        return CameraPoints(self.camera, rays_a, rays_b, self.times_ns)

    def turned(self, turn: Array) -> "CameraPoints":
        """The points if the camera is turned by a rotation vector (3,) about its right, down and forward axes."""
        pose = self.camera.ego_from_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        return replace(self, camera=replace(self.camera, ego_from_camera=pose))

    def longer(self, factor: float) -> "CameraPoints":
        """The points if the focal length is this many times the stated one."""
        scale = np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
        return self.seen_by(replace(self.camera, intrinsics=self.camera.intrinsics * scale))

    def later(self, delay_ns: int) -> "CameraPoints":
        """The points if the images were taken earlier than stated, by a delay."""
        return replace(self, times_ns=self.times_ns - delay_ns)


def misfits_px(points: CameraPoints, rows: Poses) -> Array:
    """(N,) how far each point is from where the poses would move it at any depth in front of the camera; pixels."""
    times, group = np.unique(points.times_ns, axis=0, return_inverse=True)
    poses, _ = rows.at(times)
    pose = np.broadcast_to(points.camera.ego_from_camera, (len(times), 4, 4))
    geometry = GroupGeometry(pose, pose, inverse(poses[:, 1]) @ poses[:, 0], np.zeros(2))
    focal = np.full(len(group), points.camera.intrinsics[0, 0])
    residuals = EpipolarResiduals(group.reshape(-1), points.rays_a, points.rays_b, focal)
    off = np.abs(residuals.of(geometry)[:, 0])
    turned = np.einsum("nij,nj->ni", geometry.camera_b_from_camera_a[residuals.group, :3, :3], points.rays_a)
    parallax = focal * np.linalg.norm(turned - points.rays_b, axis=-1)
    behind = (residuals.depths(geometry).max(-1) < 0) & (parallax > PARALLAX_PX)
    return np.where(behind, np.maximum(off, parallax), off)


def share(points: CameraPoints, rows: Poses) -> float:
    """How well points fit the poses, 0 to 1: a point counts half that misfits by SCALE_PX."""
    return float((1 / (1 + (misfits_px(points, rows) / SCALE_PX) ** 2)).mean())


def cost(points: CameraPoints, rows: Poses) -> float:
    """How badly points fit the poses: Cauchy's cost, in units of SCALE_PX."""
    return float(np.log1p((misfits_px(points, rows) / SCALE_PX) ** 2).sum())


def points_of(views: Items[FrameView], rows: Poses) -> dict[str, CameraPoints]:
    """The matched points of each camera that has enough of them, in the steps between views in which it moves."""
    found: dict[str, list[CameraPoints]] = {}
    for before, after in pairwise(views):
        for index, camera in enumerate(before.cameras):
            a, b = before.features[index], after.features[index]
            times = np.array([view.timestamp_ns + round(view.late_s[index] * 1e9) for view in (before, after)])
            first, second = rows.at(times)[0][:, :3, 3]
            if a is not None and b is not None and np.linalg.norm(second - first) >= LEAST_M:
                rays = matched(a, b, camera, camera)
                each = CameraPoints(camera, *rays, np.broadcast_to(times, (len(rays[0]), 2)))
                found.setdefault(camera.name, []).append(each)
    joined = {name: _joined(each) for name, each in found.items()}
    return {name: points for name, points in joined.items() if len(points.rays_a) >= FEWEST}


def _joined(parts: Items[CameraPoints]) -> CameraPoints:
    columns = ([getattr(part, name) for part in parts] for name in ("rays_a", "rays_b", "times_ns"))
    return CameraPoints(parts[0].camera, *map(np.concatenate, columns))


def camera_findings(points: Mapping[str, CameraPoints], rows: Poses, rig: CameraRig) -> tuple[Finding, ...]:
    """One finding of each camera whose points do not fit the poses, and fit where a mistake is undone; or of the poses.

    points: of `points_of`. rig: all cameras, also those without points.
    """
    stated = {name: share(each, rows) for name, each in points.items()}
    flipped = replace(rows, rotations=FLIP @ rows.rotations @ FLIP, positions=rows.positions @ FLIP)
    before, undone = (_middle([share(each, of) for each in points.values()]) for of in (rows, flipped))
    if len(points) > 1 and undone - before >= SURELY:  # of one camera, the images may be mirrored
        found = f"the points of the middle camera fit by {before:.2f} of 1 as stated, {undone:.2f} with y mirrored"
        advice = "mirror y of positions and rotations, or turn z up"
        message = "the poses are left-handed, or their z points down"
        return (Finding("motion-axes", "error", None, message, found, "x forward, y left, z up", advice),)
    findings, left = list[Finding](), dict(points)
    for gained, first, second in sorted(_exchanges(points, rows, stated, rig), reverse=True):
        if first in left and (second in left or second not in points):
            message, advice = f"its images are those of {second}, and the other way round", "exchange them"
            findings.append(_finding("images-exchanged", first, message, stated[first], gained, advice))
            left = {name: each for name, each in left.items() if name not in (first, second)}
    usual = _middle([stated[name] for name in left])
    only_coarse = usual < USUAL_SHARE or bool(findings)  # a camera that is off a little can wait for the exchanged ones
    if usual < USUAL_SHARE:
        message = "focal lengths and rotations of single cameras were not checked"
        found = f"the points of the middle camera fit the motion of the vehicle by {usual:.2f} of 1"
        findings.append(Finding("cameras-unchecked", "info", None, message, found, f"{USUAL_SHARE} or more"))
    for name, each in left.items():
        before = cost(each, rows)
        tried = _undone(each, rows, _interval_ns(points), only_coarse=only_coarse)
        told = [one for one in tried if one.is_told(rows, stated[name], before)]
        if told:
            likeliest = min(told, key=lambda one: cost(one.points, rows))
            undone = share(likeliest.points, rows)
            findings.append(_finding(likeliest.code, name, likeliest.message, stated[name], undone, likeliest.advice))
    return tuple(findings)


def _middle(shares: list[float]) -> float:
    return sorted(shares or [1.0])[len(shares) // 2]


def _finding(code: str, camera: str, message: str, stated: float, undone: float, advice: str) -> Finding:
    found = f"{stated:.2f} of 1 as stated, {undone:.2f} where this is undone"
    return Finding(code, "error", camera, message, f"its points fit the motion of the vehicle by {found}", "", advice)


def _exchanges(
    points: Mapping[str, CameraPoints], rows: Poses, stated: Mapping[str, float], rig: CameraRig
) -> Iterator[tuple[float, str, str]]:
    """The pairs of cameras whose points fit if their images are exchanged: the share of those that fit, and names."""
    reduced_size = {name: (each.camera.width, each.camera.height) for name, each in points.items()}
    for first, other in ((points[name], camera) for name in points for camera in rig.cameras if camera.name != name):
        name, size = first.camera.name, reduced_size[first.camera.name]
        if other.name in points and (other.name < name or reduced_size[other.name] != size):
            continue
        there = (
            points[other.name].camera
            if other.name in points
            else other.scaled(size[0] / other.width, size[1] / other.height)
        )
        gained = [(share(first.seen_by(there), rows), stated[name])]
        if other.name in points:
            gained.append((share(points[other.name].seen_by(first.camera), rows), stated[other.name]))
        gains = [undone - before for undone, before in gained]
        fits = len(gained) == 2 or gained[0][0] >= LEAST_SHARE  # two that fit each other's camera need not fit well
        if fits and min(gains) >= GAIN / 2 and np.mean(gains) >= EXCHANGED:
            yield float(np.mean([undone for undone, _ in gained])), name, other.name


@dataclass(frozen=True)
class _Undone:
    """The points of a camera after a mistake is undone, with the texts of its finding."""

    points: CameraPoints
    code: str
    message: str
    advice: str

    gain: float  # of the share of points that fit, at least

    def is_told(self, rows: Poses, share_before: float, cost_before: float) -> bool:
        """Whether the points fit now, and surely better than before."""
        gain, after = cost_before - cost(self.points, rows), share(self.points, rows)
        enough = after >= LEAST_SHARE and after - share_before >= self.gain
        return enough and gain >= max(COST_GAIN, COST_SHARE * cost_before)


def _undone(points: CameraPoints, rows: Poses, interval_ns: int, *, only_coarse: bool) -> Iterator[_Undone]:
    """The mistakes that one camera may have, undone. only_coarse: mirrored and late images alone."""
    yield _Undone(points.mirrored(), "images-mirrored", "its images are mirrored", "mirror them", GAIN)
    for late_ns in (interval_ns, -interval_ns):
        message, gain = f"its images are {abs(late_ns) / 1e6:.0f} ms too ", SURELY if only_coarse else GAIN
        message += "late" if late_ns > 0 else "early"
        yield _Undone(points.later(late_ns), "images-late", message, "correct their times or their order", gain)
    if only_coarse:
        return
    factor = best_focal(points, rows)
    if LEAST_LONGER <= abs(np.log(factor)) < LENGTHS[-1]:  # the longest and shortest one tried are no measurement
        message = f"the stated focal length is {1 / factor:.2f} times the one that the images show"
        yield _Undone(points.longer(factor), "focal-length", message, "calibrate the lens, or correct its scale", SMALL)
    turn = best_turn(points, rows)
    up, right, roll = np.degrees(turn)
    if LEAST_TURN_DEG <= np.linalg.norm((up, right, roll)) <= MOST_TURN_DEG:
        message = f"it looks {abs(right):.1f}° further {'right' if right > 0 else 'left'} and {abs(up):.1f}° further "
        message += f"{'up' if up > 0 else 'down'} than stated, rolled by {roll:+.1f}°"
        yield _Undone(points.turned(turn), "rotation-off", message, "measure it with `bevcli calibrate`", SMALL)


def _interval_ns(points: Mapping[str, CameraPoints]) -> int:
    return int(np.median(np.concatenate([np.ptp(each.times_ns, axis=1) for each in points.values()])))


def best_focal(points: CameraPoints, rows: Poses) -> float:
    """How many times the stated focal length the one is with which the points fit best."""
    best = 1.0
    for lengths in (LENGTHS, LENGTHS / 9):
        factors = best * np.exp(lengths)
        best = float(factors[int(np.argmax([share(points.longer(factor), rows) for factor in factors]))])
    return best


def best_turn(points: CameraPoints, rows: Poses) -> Array:
    """(3,) the rotation vector of the camera, about its right, down and forward axes, after which the points fit."""

    def residuals(turn: Array) -> Array:
        off = misfits_px(points.turned(turn), rows) / SCALE_PX
        return np.append(np.sqrt(np.log1p(off**2)), turn / TURN)

    return np.asarray(least_squares(residuals, np.zeros(3), diff_step=1e-4, x_scale=0.01).x)
