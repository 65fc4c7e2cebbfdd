"""Faults of single cameras: how the points of each camera move in its images, against how the vehicle moves.

One rule: the common mistakes are undone in turn, and the one is named after whose undoing all points fit much better.
Stated poses are exact enough for a model, but not for this: attitude and place of the vehicle at each frame are
corrected a little first, until the points of all cameras but the one in question fit. Points are matched between
successive images of a camera, and between images that two neighbours took at one time.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence as Items
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import t as student_t

from bevcli.errors import Finding
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse
from bevcli.workshop.correspondence.images import matched, neighbours
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry, Indices, solve
from bevcli.workshop.formats.pose_readings import Poses
from bevcli.workshop.odometry.step_views import FrameView, exponential

LEAST_M = 0.3  # a shorter step tells nothing
FEWEST = 60  # points of a camera
PARALLAX_PX, FAR_PX = 2.0, 100.0  # a point that moves less has no depth; misfit of one that a lens cannot show
SCALE_PX = 0.5  # a misfit of one point that counts half
SCALES_PX = (5.0, SCALE_PX)  # of the search for corrections, one after the other
# How far off poses may be at a frame that are called sound, radians and metres: bodies pitch, and maps are flat.
DEVIATIONS = np.array([np.radians(0.5)] * 3 + [0.05] * 3)
LEAST_SHARE = 0.55  # of points that fit after a mistake is undone
COARSE, SMALL = 0.1, 0.08  # by how much more than before, if images are another's, mirrored or late; of others
SURELY = 0.25  # the same of mirrored poses, and of cameras whose points do not fit well even then
FLIP = np.diag([1.0, -1.0, 1.0])
COST_GAIN, COST_SHARE = 15.0, 0.05  # of the cost, that undoing a mistake gains: of all points; of a camera's, a share
# Of a focal length, as a logarithm, and of a rotation, radians: a usual mistake, and the least one that is told.
USUAL, LEAST = {1: 0.1, 3: np.radians(2)}, {1: 0.05, 3: np.radians(1)}
CERTAIN = 0.995  # Student's quantile that these exceed in deviations, by the results without one frame
ALIKE = 0.7  # of the gain of the likeliest mistake, with which another one of the same camera is told too
ROUGH = 10.0  # times SCALE_PX, at which these are searched first
STEPS, MOST = (1, 2), 600  # frames between two images that are compared; points of a camera or of two


@dataclass(frozen=True)
class Side:
    """N matched points in G images of one camera."""

    camera: Camera  # of the images
    rays: Array  # (N, 3) unit directions, camera frame
    times_ns: NDArray[np.int64]  # (G,) when the images were taken


@dataclass(frozen=True)
class Points:
    """N points that two images of one camera, or two of different cameras, show; in G pairs of images."""

    names: tuple[str, str]  # of the cameras, as stated
    a: Side  # in the first images
    b: Side  # in the second ones
    group: Indices  # (N,) the pair of images

    def geometry(self, rows: Poses) -> GroupGeometry:
        """Of the G pairs of images."""
        poses, _ = rows.at(np.stack([self.a.times_ns, self.b.times_ns]))
        a, b = (np.broadcast_to(side.camera.ego_from_camera, poses.shape[1:]) for side in (self.a, self.b))
        return GroupGeometry(a, b, inverse(poses[1]) @ poses[0], np.zeros(2))

    @property
    def residuals(self) -> EpipolarResiduals:
        """How far the points are from their epipolar lines."""
        focal = np.full(len(self.group), self.a.camera.intrinsics[0, 0])
        return EpipolarResiduals(self.group, self.a.rays, self.b.rays, focal)

    def misfits_px(self, rows: Poses) -> Array:
        """(N,) how far each point is from where the poses would move it at any depth in front of the camera."""
        geometry, points = self.geometry(rows), self.residuals
        off = np.abs(points.of(geometry)[:, 0])
        turned = np.einsum("nij,nj->ni", geometry.camera_b_from_camera_a[self.group, :3, :3], points.rays_a)
        parallax = points.focal * np.linalg.norm(turned - points.rays_b, axis=-1)
        behind = (points.depths(geometry).max(-1) < 0) & (parallax > PARALLAX_PX)
        return np.nan_to_num(np.where(behind, np.maximum(off, parallax), off), nan=FAR_PX)

    def without(self, frame_ns: int, frames_ns: NDArray[np.int64]) -> "Points":
        """Those of images that are not of a frame."""
        times = np.stack([self.a.times_ns, self.b.times_ns], 1)
        kept = (frames_ns[np.abs(times[..., None] - frames_ns).argmin(-1)] != frame_ns).all(1)[self.group]
        a, b = (replace(side, rays=side.rays[kept]) for side in (self.a, self.b))
        return replace(self, a=a, b=b, group=self.group[kept])


@dataclass(frozen=True)
class Mistake:
    """A mistake of one camera or of two, with the texts of its finding."""

    code: str
    message: str
    advice: str
    cameras: Mapping[str, Camera]  # name of a camera that has it -> the camera that its images are of
    gain: float = SMALL  # of the share of points that fit, at least
    mirrored: bool = False
    late_ns: int = 0
    change: Array | None = None  # of the camera, see `_changed`

    def undone(self, points: Points) -> Points:
        """The points without the mistake."""
        return replace(points, a=self._without(points.names[0], points.a), b=self._without(points.names[1], points.b))

    def _without(self, name: str, side: Side) -> Side:
        camera, rays = self.cameras.get(name), side.rays
        if camera is None:
            return side
        if self.mirrored or camera.intrinsics is not side.camera.intrinsics:
            pixels, _ = side.camera.project(rays)
            rays = camera.rays(np.array([camera.width - 1, 0]) + pixels * (-1, 1) if self.mirrored else pixels)
        return Side(camera, rays, side.times_ns - self.late_ns)


@dataclass(frozen=True)
class Corrections:
    """The unknowns of `Corrections.of`: a rotation vector and a shift of the vehicle at each frame, ego frame."""

    stated: GroupGeometry
    columns: Indices  # (G, 12) those of the frames of both images
    deviations: Array  # (6 F,)

    def geometry(self, local: Array) -> GroupGeometry:
        """The geometry of all groups, `Parameters`."""
        a, b = exponential(local[:, :6]), exponential(local[:, 6:])
        return replace(self.stated, ego_b_from_ego_a=inverse(b) @ self.stated.ego_b_from_ego_a @ a)


def corrected(
    points: Items[Points], rows: Poses, frames_ns: NDArray[np.int64], start: Array | None = None
) -> tuple[Poses, Array]:
    """The poses, corrected a little at F frames so that the points fit; and the corrections (6 F,) in deviations.

    start: corrections to begin with.
    """
    deviations = np.tile(DEVIATIONS, len(frames_ns))
    x = np.zeros(len(deviations)) if start is None else start * deviations
    if not points:
        return rows, 0 * x
    counts = np.cumsum([0, *(len(each.a.times_ns) for each in points)])
    geometries, residuals = [each.geometry(rows) for each in points], [each.residuals for each in points]
    group = np.concatenate([each.group + count for each, count in zip(points, counts, strict=False)])
    together = EpipolarResiduals(group, *(_all(residuals, name) for name in ("rays_a", "rays_b", "focal")))
    names = ("ego_from_camera_a", "ego_from_camera_b", "ego_b_from_ego_a")
    a, b, motion = (_all(geometries, name) for name in names)
    times = np.concatenate([np.stack([each.a.times_ns, each.b.times_ns], 1) for each in points])
    columns = (6 * np.abs(times[..., None] - frames_ns).argmin(-1)[..., None] + np.arange(6)).reshape(-1, 12)
    unknowns = Corrections(GroupGeometry(a, b, motion, np.zeros(2)), columns, deviations)
    for scale in SCALES_PX if start is None else SCALES_PX[-1:]:
        x = solve(unknowns, [(together, scale)], x).x
    motions = exponential(np.stack([np.interp(rows.times_ns, frames_ns, column) for column in x.reshape(-1, 6).T], 1))
    positions = rows.positions + np.einsum("tij,tj->ti", rows.rotations, motions[:, :3, 3])
    return Poses(rows.times_ns, rows.rotations @ motions[:, :3, :3], positions), x / deviations


def _all(parts: Iterable[object], name: str) -> NDArray[Any]:
    return np.concatenate([getattr(part, name) for part in parts])


def misfits(points: Iterable[Points], rows: Poses) -> Array:
    """(N,) squares of how far all points are from where the poses would move them, in units of SCALE_PX."""
    return np.concatenate([np.zeros(0), *((each.misfits_px(rows) / SCALE_PX) ** 2 for each in points)])


def share(squares: Array) -> float:
    """How well points fit, of `misfits`, 0 to 1: a point counts half that misfits by SCALE_PX."""
    return float((1 / (1 + squares)).mean())


def cost(squares: Array) -> float:
    """How badly points fit, of `misfits`: Cauchy's cost."""
    return float(np.log1p(squares).sum())


def points_of(views: Items[FrameView], rows: Poses) -> list[Points]:
    """The matched points of each camera that has enough of them, in the steps between views in which it moves.

    Then those of neighbours in one view, where both have enough.
    """
    times = [view.timestamp_ns + np.rint(view.late_s * 1e9).astype(np.int64) for view in views]
    places, cameras = [rows.at(each)[0][:, :3, 3] for each in times], views[0].cameras
    found: dict[tuple[int, int], list[tuple[Side, Side]]] = {}

    def match(frames: tuple[int, int], pair: tuple[int, int]) -> None:
        """Adds the points of two cameras, the first in one frame and the second in another."""
        a, b = (views[frame].features[index] for frame, index in zip(frames, pair, strict=True))
        if a is not None and b is not None:
            rays = matched(a, b, cameras[pair[0]], cameras[pair[1]], at_once=frames[0] == frames[1])
            sides = zip(rays, frames, pair, strict=True)
            both = [Side(cameras[index], each, times[frame][[index]]) for each, frame, index in sides]
            found.setdefault(pair, []).append((both[0], both[1]))

    for frames in ((a, a + step) for step in STEPS for a in range(len(views) - step)):
        ways = np.linalg.norm(places[frames[1]] - places[frames[0]], axis=1)
        for index in np.flatnonzero(ways >= LEAST_M).tolist():
            match(frames, (index, index))
    moving = {pair[0] for pair, parts in found.items() if sum(len(a.rays) for a, _ in parts) >= FEWEST}
    for pair in (pair for pair in neighbours(cameras) if pair[0] < pair[1] and moving.issuperset(pair)):
        for frame in range(len(views)):
            match((frame, frame), pair)
    return [_joined(parts) for pair, parts in found.items() if moving.issuperset(pair)]


def _joined(parts: Items[tuple[Side, Side]]) -> Points:
    """The points of pairs of images as one, at most MOST of them."""
    counts = [len(a.rays) for a, _ in parts]
    kept = np.arange(sum(counts))[:: max(1, -(-sum(counts) // MOST))]
    a, b = (Side(of[0].camera, _all(of, "rays")[kept], _all(of, "times_ns")) for of in zip(*parts, strict=True))
    return Points((a.camera.name, b.camera.name), a, b, np.repeat(np.arange(len(parts)), counts)[kept])


def camera_findings(
    points: Items[Points], rows: Poses, views: Items[FrameView], interval_ns: int
) -> tuple[Finding, ...]:
    """One finding of each camera whose points do not fit the poses, and fit where a mistake is undone; or of the poses.

    points: of `points_of`. interval_ns: between two frames of the drive, by which images may be late.
    """
    own = [each for each in points if each.names[0] == each.names[1]]
    flipped = replace(rows, rotations=FLIP @ rows.rotations @ FLIP, positions=rows.positions @ FLIP)
    shares = ([share(misfits([each], of)) for each in own] for of in (rows, flipped))
    before, undone = (sorted(each or [1.0])[len(own) // 2] for each in shares)
    if len(own) > 1 and undone - before >= SURELY:  # of one camera, the images may be mirrored
        found = f"the points of the middle camera fit by {before:.2f} of 1 as stated, {undone:.2f} with y mirrored"
        advice = "mirror y of positions and rotations, or turn z up"
        message = "the poses are left-handed, or their z points down"
        return (Finding("motion-axes", "error", None, message, found, "x forward, y left, z up", advice),)
    findings, left = list[Finding](), [each.names[0] for each in own]
    while left:
        told = sorted(_told(points, rows, views, left, interval_ns), key=lambda one: -one[0])
        if not told:
            break
        gained, mistake, found = told[0]
        camera, kind = next(iter(mistake.cameras)), (mistake.code, mistake.cameras.keys())
        alike = [one for gain, one, _ in told if gain >= ALIKE * gained and (one.code, one.cameras.keys()) == kind]
        alike = alike[: 1 if mistake.change is None else None]
        message = ", or ".join(each.message for each in alike)
        findings.append(Finding(mistake.code, "error", camera, message, found, "", mistake.advice))
        points = [mistake.undone(each) for each in points]
        left = [name for name in left if name not in mistake.cameras]
    return tuple(findings)


def _told(
    points: Items[Points], rows: Poses, views: Items[FrameView], names: Items[str], interval_ns: int
) -> Iterator[tuple[float, Mistake, str]]:
    """Mistakes of the named cameras after whose undoing the points fit surely better: the cost gained, and in words."""
    frames_ns, cameras = np.array([view.timestamp_ns for view in views]), views[0].cameras
    fitting, x = corrected(points, rows, frames_ns)
    whole = cost(misfits(points, fitting)) + float(x @ x)
    for camera in (camera for camera in cameras if camera.name in names):
        others, start = corrected([each for each in points if camera.name not in each.names], rows, frames_ns)
        for mistake in _mistakes(camera, points, others, cameras, interval_ns):
            mine = [each for each in points if not mistake.cameras.keys().isdisjoint(each.names)]
            undone = [mistake.undone(each) for each in mine]
            # A second camera with the same mistake makes the corrections worse than none.
            tried = [(misfits(undone, fitting), misfits(mine, fitting)) for fitting in (others, rows)]
            sides = max(tried[: 1 if mistake.change is not None else 2], key=lambda each: share(each[0]))
            (after, before), (left, stated) = map(share, sides), map(cost, sides)
            fits = after - before >= (mistake.gain if after >= LEAST_SHARE else SURELY)
            if not fits or stated - left < COST_SHARE * stated:
                continue
            if mistake.change is not None and not _is_certain(camera, mistake.change, mine, others, frames_ns):
                continue
            changed = [mistake.undone(each) for each in points]
            fitting, x = corrected(changed, rows, frames_ns, None if mistake.change is None else start)
            gained = whole - cost(misfits(changed, fitting)) - float(x @ x)
            if gained >= COST_GAIN:
                found = f"its points fit the motion of the vehicle by {before:.2f} of 1 as stated, {after:.2f} where "
                yield gained, mistake, found + "this is undone"


def _is_certain(
    camera: Camera, change: Array, points: Items[Points], rows: Poses, frames_ns: NDArray[np.int64]
) -> bool:
    """Whether a change of a camera is much larger than the spread of those that its points show without one frame."""
    few = ([each.without(frame, frames_ns) for each in points] for frame in frames_ns.tolist())
    spread = np.std([_best(camera, each, rows, len(change)) for each in few], axis=0) * np.sqrt(len(frames_ns) - 1)
    least = np.maximum(student_t.ppf(CERTAIN, len(frames_ns) - 1) * spread, LEAST[len(change)])
    return bool((np.abs(change) >= least).any())


def _mistakes(
    camera: Camera, points: Items[Points], rows: Poses, cameras: Items[Camera], interval_ns: int
) -> Iterator[Mistake]:
    """The mistakes that a camera may have. rows: as the other cameras show them."""
    name, mine = camera.name, [each for each in points if camera.name in each.names]
    for other in cameras:
        if other.name != name and (other.width, other.height) == (camera.width, camera.height):
            message = f"its images are those of {other.name}, and the other way round"
            yield Mistake("images-exchanged", message, "exchange them", {name: other, other.name: camera}, COARSE)
    yield Mistake("images-mirrored", "its images are mirrored", "mirror them", {name: camera}, COARSE, mirrored=True)
    for late_ns in (interval_ns, -interval_ns):
        message = f"its images are {abs(late_ns) / 1e6:.0f} ms too {'late' if late_ns > 0 else 'early'}"
        advice = "correct their times or their order"
        yield Mistake("images-late", message, advice, {name: camera}, COARSE, late_ns=late_ns)
    for count in LEAST:
        change = _best(camera, mine, rows, count)
        if np.linalg.norm(change) >= LEAST[count]:
            message, advice = _in_words(change), "measure it with `bevcli calibrate`, or calibrate the lens"
            yield Mistake("calibration-off", message, advice, {name: _changed(camera, change)}, change=change)


def _in_words(change: Array) -> str:
    if len(change) == 1:
        return f"the stated focal length is {np.exp(-change[0]):.2f} times the one that the images show"
    up, right, roll = np.degrees(change)
    sides = f"{abs(right):.1f}° further {'right' if right > 0 else 'left'} and {abs(up):.1f}° further "
    return f"it looks {sides}{'up' if up > 0 else 'down'} than stated, rolled by {roll:+.1f}°"


def _changed(camera: Camera, by: Array) -> Camera:
    """The camera, turned by a rotation vector (3,), or with the focal length times the exponential of (1,)."""
    if len(by) == 1:
        scale = np.exp(by[0])
        return replace(camera, intrinsics=camera.intrinsics * [[scale, 1, 1], [1, scale, 1], [1, 1, 1]])
    pose = camera.ego_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(by).as_matrix()
    return replace(camera, ego_from_camera=pose)


def _best(camera: Camera, points: Items[Points], rows: Poses, count: int) -> Array:
    """(count,) the change of a camera after which its points fit best, see `_changed`."""

    def residuals(by: Array, scale: float) -> Array:
        undone = Mistake("", "", "", {camera.name: _changed(camera, by)}).undone
        return np.append(np.sqrt(np.log1p(misfits(map(undone, points), rows) / scale**2)), by / USUAL[count])

    change = np.zeros(count)
    for scale in (ROUGH, 1.0):
        change = least_squares(residuals, change, diff_step=1e-4, x_scale=0.01, args=(scale,)).x
    return change
