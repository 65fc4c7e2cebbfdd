"""What a drive says of each camera and of the whole rig, and its texts."""

from collections.abc import Sequence as Items
from dataclasses import asdict, dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.geometry.transforms import Array, inverse
from bevcli.workshop.correspondence.residuals import GroupGeometry, Indices, Solution

OF_CAMERA = 7  # unknowns: rotation, position, delay
HEIGHT = 5  # index of a camera's height among them
OF_PAIR = 3  # the error of the vehicle's rotation; or of lenses
OF_RIG = 3  # scale of the ego-motion, slope of the road along x and y
DELAYS_S = np.linspace(-0.3, 0.3, 25)  # of a camera's capture times, where the motion of a pair is tabulated


@dataclass(frozen=True)
class Unknowns:
    """The layout of the vector of unknowns, x, and the stated values from which it counts.

    x holds for each camera its rotation (3, radians, in the camera frame), position (3, metres, in the ego frame) and
    delay (seconds); for each pair the rotation of the vehicle (3, radians); for each two neighbours the rotation that
    errors of their lenses look like at one time (3, radians, in the ego frame); at last the scale of the ego-motion (a
    share), and the slopes of the road along x and y of the ego frame. Poses are quaternions (x, y, z, w) and
    translations.
    """

    stated: Array  # (C, 4, 4) ego_from_camera
    poses: Array  # (G, 2, 25, 7) world_from_ego of both images of a group, by delay
    groups: Indices  # (G, 3) pair, camera of the first image and camera of the second one
    turns: Indices  # (G,) the rotation that the group depends on: that of its pair, or else of its two cameras
    pairs: int
    neighbours: int  # pairs of neighbours
    deviations: Array  # (P,) the standard deviation of each unknown before anything is measured

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.stated)

    @cached_property
    def within_camera(self) -> Indices:
        """The groups whose images are of the same camera."""
        return np.flatnonzero(self.groups[:, 1] == self.groups[:, 2])

    @cached_property
    def moves(self) -> NDArray[np.bool_]:
        """(G,) whether the images of a group are of both frames of its pair; else both are of the first one."""
        return np.asarray(self.turns < self.pairs)

    @cached_property
    def columns(self) -> Indices:
        """(G, 20) the indices in x of the unknowns that a group depends on: two cameras, the pair, and the rig."""
        _, first, second = self.groups.T[..., None]
        start = OF_CAMERA * self.cameras
        rig = start + OF_PAIR * (self.pairs + self.neighbours)
        of_rig = np.broadcast_to(rig + np.arange(OF_RIG), (len(self.groups), OF_RIG))
        cameras = [OF_CAMERA * index + np.arange(OF_CAMERA) for index in (first, second)]
        return np.concatenate([*cameras, start + OF_PAIR * self.turns[:, None] + np.arange(OF_PAIR), of_rig], axis=-1)

    def of_camera(self, x: Array) -> Array:
        """(C, 7) rotation, position and delay of each camera."""
        return x[: OF_CAMERA * self.cameras].reshape(self.cameras, OF_CAMERA)

    def geometry(self, local: Array) -> GroupGeometry:
        """The geometry of all groups. local: (G, 20), the values of `columns`."""
        of_a, of_b, turn, rig = np.split(local, np.cumsum([OF_CAMERA, OF_CAMERA, OF_PAIR]), axis=-1)
        (_, first, second), ego_from_camera = self.groups.T, self.stated
        before, after = (_pose_at(self.poses[:, side], camera[:, 6]) for side, camera in enumerate((of_a, of_b)))
        motion = inverse(after) @ before
        motion[:, :3, :3] = motion[:, :3, :3] @ Rotation.from_rotvec(turn * self.moves[:, None]).as_matrix()
        motion[:, :3, 3] *= 1 + rig[:, :1]
        pose_a, pose_b = moved(ego_from_camera[first], of_a), moved(ego_from_camera[second], of_b)
        pose_a[:, :3, :3] = Rotation.from_rotvec(turn * ~self.moves[:, None]).as_matrix() @ pose_a[:, :3, :3]
        return GroupGeometry(pose_a, pose_b, motion, rig[0, 1:])


def moved(ego_from_camera: Array, change: Array) -> Array:
    """Poses (C, 4, 4) with a change (C, 6 or 7): rotation in the camera frame, radians; position in ego, metres."""
    result = ego_from_camera.copy()
    result[:, :3, :3] = ego_from_camera[:, :3, :3] @ Rotation.from_rotvec(change[:, :3]).as_matrix()
    result[:, :3, 3] += change[:, 3:6]
    return result


def _pose_at(table: Array, delay: Array) -> Array:
    """(G, 4, 4) poses of tables (G, 25, 7) at delays (G,), seconds."""
    index = (delay - DELAYS_S[0]) / (DELAYS_S[1] - DELAYS_S[0])
    before = np.clip(index.astype(int), 0, len(DELAYS_S) - 2)
    share, every = (index - before)[:, None], np.arange(len(table))
    pose = (1 - share) * table[every, before] + share * table[every, before + 1]
    result = np.tile(np.eye(4), (len(table), 1, 1))
    result[:, :3, :3] = Rotation.from_quat(pose[:, :4]).as_matrix()
    result[:, :3, 3] = pose[:, 4:]
    return result


SMALLEST_TURN = np.radians(0.005)  # of it


def with_estimated_turns(unknowns: Unknowns, solution: Solution) -> Unknowns:
    """The unknowns with the deviation of the vehicle's stated rotation that its pairs show, at most the present one.

    It is estimated an axis, as the scatter of the solution over what the pairs determine (MacKay's rule).
    """
    deviations = unknowns.deviations.copy()
    start = OF_CAMERA * unknowns.cameras
    turns = slice(start, start + OF_PAIR * unknowns.pairs)
    covariance = np.linalg.inv(solution.information + np.diag(1 / deviations**2))
    determined = (1 - np.diag(covariance)[turns] / deviations[turns] ** 2).reshape(-1, OF_PAIR).sum(0)
    squares = (solution.x[turns] ** 2).reshape(-1, OF_PAIR).sum(0)
    estimated = np.maximum(np.sqrt(squares / np.maximum(determined, 1)), SMALLEST_TURN)
    deviations[turns] = np.minimum(deviations[turns], np.tile(estimated, unknowns.pairs))
    return replace(unknowns, deviations=deviations)


Triple = tuple[float, float, float]
HEADER = (
    "camera", "yaw off by", "pitch", "roll", "x off by", "y", "z", "matches", "residual px", "verdict",
)  # fmt: skip
MEASURED_MOTION = (
    "the motion is measured from the images (rounds: {rounds}): height and scale cannot be told apart (a rig that is "
    "higher, on a vehicle that is faster, sees the same), so heights count from their stated mean; nor can yaw and "
    "direction, so yaw counts from its stated mean: all cameras are off by {yaw:+.2f}° ± {deviation:.2f}° more if the "
    "vehicle drives along x"
)
CERTAIN_DELAY = (3.0, 10.0)  # of a delay that is told: in standard deviations, and in milliseconds
TOLD_DELAY_MS = 25.0  # the largest deviation of a delay that counts as measured
MOST_DELAY_MS = 300.0  # a larger one is a rotation


class Verdict(Enum):
    """What is done with a camera's calibration."""

    FINE = "fine"
    CORRECTED = "corrected"
    NOT_MEASURABLE = "not measurable"


@dataclass(frozen=True)
class CameraEstimate:
    """What a drive says about one camera. Deviations are standard deviations."""

    camera: str  # its name
    verdict: Verdict  # what is done with its calibration
    reason: str  # why it is not measurable; "" else
    rotation_deg: Triple  # yaw, pitch and roll of the stated rotation minus the measured one, as in `Mounting`
    rotation_deviation_deg: Triple
    position_m: Triple  # x, y, z of the stated position minus the measured one, ego frame
    position_deviation_m: Triple  # that of the stated position where nothing is measured
    delay_ms: float  # how much later than stated its images were taken
    delay_deviation_ms: float
    matches: int  # number of matched points
    road_points: int  # number of points of the road
    before_px: float  # median residual of the matched points with the stated calibration, of the original image
    after_px: float  # the same with the measured one
    change: Array  # (7,) rotation in the camera frame, radians; position in the ego frame, metres; delay, seconds
    covariance: Array  # (7, 7) of it

    def to_dict(self) -> dict[str, Any]:
        """For the report."""
        entry = asdict(self) | {"verdict": self.verdict.value}
        return entry | {"change": self.change.tolist(), "covariance": self.covariance.tolist()}


@dataclass(frozen=True)
class RigEstimate:
    """What a drive says about the whole rig. Deviations are standard deviations."""

    scale: float  # of the ego-motion minus 1: 0.01 if the vehicle drove 1 % farther than stated
    scale_deviation: float
    height_m: float  # mean height of the cameras above the road, stated minus measured
    height_deviation_m: float
    tilt_deg: tuple[float, float]  # pitch and roll of the ego frame over the road: positive if front, left point down
    tilt_deviation_deg: tuple[float, float]


def rig_text(whole: RigEstimate, cameras: Items[CameraEstimate], interval_ms: float | None = None) -> str:
    """Lines about the whole rig, and about the capture times of its cameras. interval_ms: see `CalibrationResult`."""
    pitch, roll = (f"{a:+.2f}° ± {d:.2f}°" for a, d in zip(whole.tilt_deg, whole.tilt_deviation_deg, strict=True))
    lines = [
        f"height of the rig over the road off by {_metres(whole.height_m, whole.height_deviation_m)}; "
        f"tilt of the ego frame: pitch {pitch}, roll {roll}",
        f"scale of the ego-motion off by {-100 * whole.scale:+.1f} % ± {100 * whole.scale_deviation:.1f} %",
    ]
    common = common_delay_text(cameras, interval_ms)
    texts = [common] if common else [delay_text(estimate) for estimate in cameras]
    texts += [either_text(estimate) for estimate in cameras]
    return "\n".join([*lines, *(f"time offset: {text}" for text in texts if text)])


def common_delay_text(cameras: Items[CameraEstimate], interval_ms: float | None) -> str:
    """A time offset that is certain and the same for all cameras, in words; "" where there is none."""
    told = [estimate for estimate in cameras if estimate.delay_deviation_ms <= TOLD_DELAY_MS]
    if not told or len(told) < min(2, len(cameras)):
        return ""
    delays, deviations = np.array([(estimate.delay_ms, estimate.delay_deviation_ms) for estimate in told]).T
    delay, deviation = float(np.average(delays, weights=1 / deviations**2)), float(deviations.min())
    differ = np.abs(delays - delay) > CERTAIN_DELAY[0] * deviations
    if differ.any() or abs(delay) < max(CERTAIN_DELAY[0] * deviation, CERTAIN_DELAY[1]):
        return ""
    of = "all cameras" if len(cameras) > 1 else told[0].camera
    text = (
        f"the images of {of} were taken {abs(delay):.0f} ± {deviation:.0f} ms {_word(delay)} than stated, or the poses "
        f"are of times that much {_word(-delay)}"
    )
    if interval_ms is None:
        return text
    return (
        f"{text}, or the frames, one each {interval_ms:g} ms as stated, were not taken evenly: all of it explains this"
    )


def delay_text(estimate: CameraEstimate) -> str:
    """A time offset that is certain, in words; "" where there is none."""
    deviations, least = CERTAIN_DELAY
    size, deviation = abs(estimate.delay_ms), estimate.delay_deviation_ms
    if deviation > TOLD_DELAY_MS or size < max(deviations * deviation, least):
        return ""
    word = _word(estimate.delay_ms)
    return f"the images of {estimate.camera} were taken {size:.0f} ± {deviation:.0f} ms {word} than stated"


def either_text(estimate: CameraEstimate) -> str:
    """A time offset or a rotation, in words, where the motion does not tell which of both; "" where it does.

    A vehicle that turns evenly moves a late camera as if it were turned.
    """
    rotation, covariance = estimate.change[:3], estimate.covariance
    if estimate.verdict is Verdict.FINE or estimate.delay_deviation_ms <= TOLD_DELAY_MS:
        return ""
    gain = np.linalg.solve(covariance[:3, :3], covariance[:3, 6])
    delay_ms = 1000 * float(estimate.change[6] - gain @ rotation)  # if the stated rotation is right
    deviation_ms = 1000 * float(np.sqrt(max(covariance[6, 6] - gain @ covariance[:3, 6], 0)))
    certain = max(CERTAIN_DELAY[0] * deviation_ms, CERTAIN_DELAY[1])
    if deviation_ms > TOLD_DELAY_MS or not certain <= abs(delay_ms) <= MOST_DELAY_MS:
        return ""
    turned = rotation - covariance[:3, 6] / covariance[6, 6] * estimate.change[6]  # if the stated times are right
    return (
        f"the images of {estimate.camera} were taken {abs(delay_ms):.0f} ms {_word(delay_ms)} than stated, or it is "
        f"turned by {np.degrees(np.linalg.norm(turned)):.1f}°: the drive does not tell which of both"
    )


def _word(delay_ms: float) -> str:
    return "later" if delay_ms > 0 else "earlier"


def change_text(estimate: CameraEstimate) -> str:
    """How far a camera is off, in words: "off by yaw +1.98° ± 0.05°, z +0.150 m ± 0.005 m", and so on."""
    rotation = zip(("yaw", "pitch", "roll"), estimate.rotation_deg, estimate.rotation_deviation_deg, strict=True)
    position = zip("xyz", estimate.position_m, estimate.position_deviation_m, strict=True)
    parts = [f"{name} {value:+.2f}° ± {deviation:.2f}°" for name, value, deviation in rotation]
    parts += [f"{name} {value:+.3f} m ± {deviation:.3f} m" for name, value, deviation in position if value]
    return "off by " + ", ".join(parts)


def row(estimate: CameraEstimate) -> tuple[str, ...]:
    if estimate.verdict is Verdict.NOT_MEASURABLE:
        cells = ["–"] * 6
    else:
        pairs = zip(estimate.rotation_deg, estimate.rotation_deviation_deg, strict=True)
        cells = [f"{value:+.2f}±{deviation:.2f}°" for value, deviation in pairs]
        places = zip(estimate.position_m, estimate.position_deviation_m, strict=True)
        cells += [_metres(value, deviation) for value, deviation in places]
    verdict = estimate.verdict.value + (f": {estimate.reason}" if estimate.reason else "")
    residual = f"{estimate.before_px:.2f} → {estimate.after_px:.2f}" if estimate.matches else "–"
    return (estimate.camera, *cells, f"{estimate.matches}", residual, verdict)


def _metres(value: float, deviation: float) -> str:
    return f"{value:+.3f}±{deviation:.3f} m"
