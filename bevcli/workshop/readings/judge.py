"""The reading of a rig and of poses that the images show, or the question to the user."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation

from bevcli.errors import Finding, InputError
from bevcli.frame import Drive
from bevcli.geometry.transforms import Array, inverse, rigid
from bevcli.options import named
from bevcli.sequences.files.calibration_file import CONTRADICTED, RigDraft
from bevcli.sequences.files.ego_motion_file import ReadPoses
from bevcli.sequences.files.readings import PoseReading, Reading, RigReading, differing, question
from bevcli.sequences.images import ListedDrive
from bevcli.sequences.options import RigOptions
from bevcli.workshop.formats.calibrations import poses_in_words
from bevcli.workshop.formats.camera_poses import on_both_sides
from bevcli.workshop.formats.pose_readings import ASIDE, FASTEST_M_S, MOVING_M_S, Poses, in_usual_axes
from bevcli.workshop.formats.poses import of_reading
from bevcli.workshop.readings.pairs import (
    MatchedPoints,
    PointsAtOnce,
    body_motions,
    camera_pairs,
    height_above_road,
    moving_pairs,
    timed_pairs,
)

SOUND_PX = (2.5, 1.0, 0.7)  # largest residual of a reading that is believed, reduced pixels, by its rank
CLEAR, CLEAR_PX = 2.0, 0.2  # factor and addition, by which the residuals of all others are larger
EXACT, EXACT_PX = 1.5, 0.1  # the same where images and rig are exact (`FLOOR_PX`)
NEAR, NEAR_PX = 1.25, 0.05  # the same, of readings of which the usual one is believed
FLOOR_PX = 0.3  # no other reading is clearly better than one with this
UNFIT_PX = 5.0  # residual of a reading that is not believed though no other is better
LOWEST_M = -0.2  # mean height of usual cameras above the origin, which may be at a roof
SAME_RAD, SAME_M, SAME = np.radians(0.25), 0.02, 0.01  # steps and cameras that differ less are the same
CONTRADICTING = 3.0  # the same factor, of what is stated
LEAST_OFF_PX, OFF = 0.4, 2.2  # residual of poses that may be late or of another point; how much smaller it is without
LATE_NS, LATEST_NS = 50_000_000, 500_000_000  # step in which the times of the poses are tried, and the largest
LATE_WITHIN_NS = 500_000  # how exactly their best time is found
LEAST_LATE_NS = 40_000_000  # a smaller one, such as an exposure and the way through a driver, is no mistake of a file
TRIED_POINTS, FARTHEST_POINT_M = 80, 4.0  # of the vehicle, that the poses may be of
OTHER_SCALE = 1.25  # of heights above the road, that the poses tell, over those of a rig that is certain
CLEAR_HEIGHT = 1.5  # clearness of a height that is believed
SAME_HEIGHT_M, SAME_HEIGHT = 0.12, 0.08  # heights that differ less are the same: metres, and a share
LOWEST_OF_GROUND_M = 1.2  # of the highest camera, if the origin is surely on the ground
FEWEST_PAIRS, SURE_PAIRS = 2, 4  # of images, that decide; that refuse the only reading
FEWEST_POINTS = 80  # matched in all of them; two cameras at night may see one car
FRAMES_AT_ONCE = 2  # of a vehicle that stands, whose cameras see points together
FEWEST_AT_ONCE, SHARE_AT_ONCE = 15, 0.25  # of these points in the reading that fits best; in others that may be meant
MOST_RANK = 4  # of a rig and poses
AROUND_NS = 10**9  # before and after the frames, as images may be a little off their times
CHORD_NS, CHORDS = 500_000_000, 60  # of short steps, by which readings are compared
MOST_SLOW = 0.9  # share of the steps that must not be too fast
BOTH = ("rig_axes", "pose_axes")


@dataclass(frozen=True, eq=False)
class Candidate:
    """A reading of the rig and one of the poses, together."""

    rig: RigReading | None  # None where the rig is certain
    poses: PoseReading | None  # None where they are certain, or there are none
    cameras: Array  # (P, 4, 4) ego_from_camera of each pair of images
    steps: Array  # (P, 4, 4) ego_b_from_ego_a
    way: Array  # (S, 4, 4) ego_b_from_ego_a of short steps all over the drive
    residual_px: float = np.inf  # of the matched points; infinite where nothing was compared

    @property
    def whole(self) -> Reading:
        """Both readings as one."""
        return Reading({**(self.rig.states if self.rig else {}), **(self.poses.states if self.poses else {})})

    def is_like(self, other: "Candidate") -> bool:
        """True where both mean the same."""
        rigs = [[] if each.rig is None else list(each.rig.ego_from_camera.values()) for each in (self, other)]
        return _alike(*(np.array(rig).reshape(-1, 4, 4) for rig in rigs)) and _alike(self.way, other.way)

    @property
    def rank(self) -> int:
        """That of both readings: 0 for usual ones."""
        is_below = (
            self.rig is not None and np.mean([pose[2, 3] for pose in self.rig.ego_from_camera.values()]) < LOWEST_M
        )
        return sum(each.rank for each in (self.rig, self.poses) if each) + int(is_below)

    @property
    def is_sound(self) -> bool:
        """True where the images fit."""
        return self.residual_px <= SOUND_PX[min(self.rank, len(SOUND_PX) - 1)]

    @property
    def is_forward(self) -> bool:
        """False for a vehicle that drives backwards."""
        return not len(self.way) or float(self.way[:, 0, 3].sum()) <= 0


def _alike(a: Array, b: Array) -> bool:
    if not len(a):
        return True
    turns = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]).magnitude()
    apart, length = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1), np.linalg.norm(a[:, :3, 3], axis=1)
    return bool((turns < SAME_RAD).all() and (apart < SAME_M + SAME * length).all())


def decide(draft: RigDraft, poses: ReadPoses, drive: ListedDrive, options: RigOptions) -> tuple[RigDraft, ReadPoses]:
    """The rig and the poses of a drive as the images show them, each with a note that says what decided.

    Args:
        draft: the rig, with its readings.
        poses: with their readings.
        drive: its frames, with any of the rigs and poses.
        options: what the user states.

    Raises InputError where the images do not decide: it names the options that do.
    """
    judged = Judged(draft, poses, drive, options)
    chosen, evidence = judged.chosen()
    if chosen.rig is not None:
        reading, raised = chosen.rig, ""
        if options.height is None:
            up, raised = judged.raised_by(chosen)
            poses_of = {name: rigid((0, 0, up)) @ pose for name, pose in reading.ego_from_camera.items()}
            reading = replace(reading, ego_from_camera=poses_of)
        draft = _with_rig(draft, reading, evidence, raised)
    if chosen.poses is not None and chosen.poses.note:
        assert poses.motion is not None
        read = of_reading(chosen.poses, poses.motion.timestamps_ns, draft.rig)
        notes = tuple(f"{note} ({evidence})" if evidence and chosen.rig is None else note for note in read.notes)
        poses = replace(poses, motion=read.motion, notes=notes, readings=())
    if contradiction := judged.contradiction(chosen):
        if draft.others:
            draft = replace(draft, findings=(*draft.findings, Finding(CONTRADICTED, "warning", None, contradiction)))
        else:
            poses = replace(poses, notes=(*poses.notes, contradiction))
    return draft, poses


def _with_rig(draft: RigDraft, reading: RigReading, evidence: str, raised: str) -> RigDraft:
    """The draft with the cameras where a reading has them."""
    cameras = tuple(replace(each, ego_from_camera=reading.ego_from_camera[each.name]) for each in draft.rig.cameras)
    first, *others = draft.findings
    how = poses_in_words(reading) + (f" ({evidence})" if evidence else "") + raised
    text = first.message.replace(poses_in_words(draft.readings[0]), how)
    rig = replace(draft.rig, cameras=cameras)
    return replace(draft, rig=rig, findings=(replace(first, message=text), *others), readings=())


class Judged:
    """The candidates of a drive, compared with its images."""

    def __init__(self, draft: RigDraft, poses: ReadPoses, drive: Drive, options: RigOptions) -> None:
        self._draft, self._poses, self._drive, self._options = draft, poses, drive, options
        self._times = np.array([stamp.timestamp_ns for stamp in drive.stamps], dtype=np.int64)
        self._pairs = list(camera_pairs(drive, self._frames())) if options.image_check else []
        if sum(len(pair.rays_a) for pair in self._pairs) < FEWEST_POINTS:
            self._pairs = []
        self._points = MatchedPoints(self._pairs) if self._pairs else None
        self._heights: dict[Candidate, float | None] = {}

    def _frames(self) -> list[tuple[int, int]]:
        """The pairs of frames that are compared."""
        tracks = list(_tracks(self._poses, self._times).values())
        if not tracks:
            return timed_pairs(self._times)
        at = [track.at(self._times)[0] for track in tracks]
        units = [each.states.get("pose_unit", "m") for each in self._poses.readings] or ["m"]
        of_unit: dict[str, list[Array]] = {}
        for unit, each in zip(units, at, strict=True):
            of_unit.setdefault(unit, []).append(np.linalg.norm(np.diff(each[:, :3, 3], axis=0), axis=1))
        ways = np.stack([np.min(each, axis=0) for each in of_unit.values()])
        turns = inverse(at[0][:-1]) @ at[0][1:]
        turned = Rotation.from_matrix(turns[:, :3, :3]).magnitude()
        return moving_pairs(
            self._times,
            *(np.concatenate([[0], np.cumsum(each)]) for each in (np.prod(ways, axis=0) ** (1 / len(ways)), turned)),
        )

    def candidates(self, draft: RigDraft, poses: ReadPoses) -> list[Candidate]:
        """The possible pairs of readings, those that fit best first; those of a high rank where no others fit."""
        found: list[Candidate] = []
        for rank in range(MOST_RANK + 1):
            found = sorted([*found, *self._of_rank(draft, poses, rank)], key=lambda each: each.residual_px)
            is_usual = bool(found) and found[0].rank <= rank
            if is_usual and (not self._pairs or found[0].residual_px <= FLOOR_PX or (rank and found[0].is_sound)):
                break
        return found

    def _of_rank(self, draft: RigDraft, poses: ReadPoses, rank: int) -> Iterator[Candidate]:
        rigs: list[RigReading | None] = list(draft.readings) or [None]
        readings: list[PoseReading | None] = list(poses.readings) or [None]
        at = np.array([pair.times_ns for pair in self._pairs], dtype=np.int64).reshape(-1, 2)
        short, nothing = self._short_steps(), np.zeros((0, 4, 4))
        motions = {
            index: (body_motions(track.at(at)[0]), body_motions(track.at(short)[0]))
            for index, track in _tracks(poses, self._times).items()
        }
        for rig, (index, reading) in product(rigs, enumerate(readings)):
            if sum(each.rank for each in (rig, reading) if each) != rank:
                continue
            where = self._cameras(rig)
            cameras = np.array([where[pair.camera.name] for pair in self._pairs]).reshape(-1, 4, 4)
            body = where[reading.camera] if reading is not None and reading.camera else np.eye(4)
            steps, way = (body @ each @ inverse(body) for each in motions.get(index, (nothing, nothing)))
            if not _is_possible(way, short):
                continue
            if self._points is not None and not motions:
                steps = self._points.motions_seen(cameras)
            residual = np.inf if self._points is None else self._points.residual_px(cameras, steps)
            yield Candidate(rig, reading, cameras, steps, way, residual)

    def _cameras(self, rig: RigReading | None) -> Mapping[str, Array]:
        """ego_from_camera (4, 4) of each camera."""
        stated = {each.name: each.ego_from_camera for each in self._drive.rig.cameras}
        return stated if rig is None else rig.ego_from_camera

    def _short_steps(self) -> NDArray[np.int64]:
        """(S, 2) times of short steps all over the drive; none without poses."""
        motion = self._poses.motion
        if motion is None:
            return np.zeros((0, 2), dtype=np.int64)
        first, last = max(motion.first_ns, int(self._times[0])), min(motion.last_ns, int(self._times[-1]))
        starts = np.linspace(first, max(first, last - CHORD_NS), CHORDS).astype(np.int64)
        return np.stack([starts, np.minimum(starts + CHORD_NS, max(first, last))], axis=1)

    def chosen(self) -> tuple[Candidate, str]:
        """The candidate that the images show, and the evidence in words. Raises InputError."""
        found = self.candidates(self._draft, self._poses)
        if not found:
            options = ", ".join(named(RigOptions, name) for name in ("rig_axes", "pose_axes", "poses_of"))
            raise InputError(
                f"{self._files(BOTH)}: in no reading the vehicle drives along its x axis, at most {FASTEST_M_S:g} m/s: "
                f"correct the poses, or state what they are by {options} or {named(RigOptions, 'pose_transform')}"
            )
        least = found[0].residual_px
        larger = (EXACT, EXACT_PX) if least <= FLOOR_PX else (CLEAR, CLEAR_PX)
        near, clear = (times * least + more for times, more in ((NEAR, NEAR_PX), larger))
        best = min(found, key=lambda each: (each.residual_px > near, each.rank))
        usual = [each for each in found if each.rank <= best.rank]
        unsound = not best.is_sound or len(self._pairs) < FEWEST_PAIRS
        left = usual if unsound else [each for each in usual if each.residual_px <= clear]
        left = [each for index, each in enumerate(left) if not any(each.is_like(other) for other in left[:index])]
        if unsound and differing([each.whole for each in left]) == ["pose_transform"]:
            left = [each for each in left if each.is_forward] or left
        if len(left) > 1 and self._options.image_check and len(self._pairs) < FEWEST_PAIRS:
            left, evidence = self._seen_at_once(left)
            if len(left) == 1:
                return left[0], evidence
        if len(left) > 1 and not unsound:
            left = [each for each in left if self._missing_height(each) == 0] or left
        is_stated = bool(self._draft.others or self._poses.others)
        is_unfit = best.residual_px > UNFIT_PX and len(self._pairs) >= SURE_PAIRS and not is_stated
        wrong = "" if is_stated else self._other_fit(left[0], found)
        if len(left) > 1 and not is_unfit and not wrong:
            return self._on_both_sides(left)
        if not wrong and (is_unfit or (unsound and best.rank and len(self._pairs) >= FEWEST_PAIRS and not is_stated)):
            raise InputError(
                f"{self._files(BOTH)}: the images fit no reading; best, {best.whole.words()} (residual "
                f"{best.residual_px:.1f} px): correct the file, pass `odometry=True` (`--odometry`) in place of the "
                "poses, or `image_check=False` (`--no-image-check`) to read it so"
            )
        if wrong := wrong or self._other_scale(left[0]):
            raise InputError(
                f"{self._files(BOTH)}: {wrong}; correct the files, pass `odometry=True` (`--odometry`) in place of "
                "the poses, or `image_check=False` (`--no-image-check`) to read them so"
            )
        others = [each for each in found if not each.is_like(left[0])]
        if not others or not np.isfinite(best.residual_px):
            return left[0], ""
        names = differing([left[0].whole, others[0].whole])
        other = f"{others[0].whole.words(names)}: {others[0].residual_px:.1f} px"
        return left[0], f"the images: {left[0].residual_px:.1f} px; {other}"

    def _seen_at_once(self, left: list[Candidate]) -> tuple[list[Candidate], str]:
        """The readings in which two cameras see points together, and the evidence; all where they see too few."""
        frames = sorted({0, len(self._times) // FRAMES_AT_ONCE})
        points = PointsAtOnce(self._drive, frames)
        counts = [points.fitting(self._cameras(each.rig)) for each in left]
        most = max(counts)
        if most < FEWEST_AT_ONCE:
            return left, ""
        fitting = [each for each, count in zip(left, counts, strict=True) if count > SHARE_AT_ONCE * most]
        others = [(each, count) for each, count in zip(left, counts, strict=True) if count <= SHARE_AT_ONCE * most]
        if not others:
            return left, ""
        other, count = max(others, key=lambda each: each[1])
        names = differing([fitting[0].whole, other.whole])
        text = f"the images: two cameras see {most} points at once; {other.whole.words(names)}: {count}"
        return fitting, text

    def fitting(self, chosen: Candidate | None) -> tuple[Candidate, str] | None:
        """The reading that fits the images where what is stated does not, and the residual of that, in words.

        chosen: what is stated; None where no vehicle moves so.
        """
        if not (self._draft.others or self._poses.others) or len(self._pairs) < FEWEST_PAIRS:
            return None
        draft = replace(self._draft, readings=self._draft.others or self._draft.readings)
        poses = replace(self._poses, readings=self._poses.others or self._poses.readings)
        fitting = next(iter(self.candidates(draft, poses)), None)
        if fitting is None or not fitting.is_sound:
            return None
        if chosen is None:
            return fitting, "the vehicle moves aside or too fast"
        is_clear = chosen.residual_px >= CONTRADICTING * fitting.residual_px + CLEAR_PX
        return (fitting, f"{chosen.residual_px:.1f} px") if is_clear else None

    def contradiction(self, chosen: Candidate) -> str:
        """What fits the images where what is stated does not, as options; "" for none."""
        if (found := self.fitting(chosen)) is None:
            return ""
        fitting, residual_px = found
        flags = fitting.whole.flags(differing([chosen.whole, fitting.whole]))
        return (
            f"what is stated does not fit the images (residual {residual_px}): they fit `{flags}` "
            f"({fitting.residual_px:.1f} px)"
        )

    def _other_fit(self, chosen: Candidate, found: Sequence[Candidate]) -> str:
        """How late poses, of another point, or images without a lens would fit much better; "" if not so.

        An unusual rig is not believed where a usual one would fit as well so. found: all readings.
        """
        if chosen.poses is None or len(self._pairs) < FEWEST_PAIRS:
            return ""
        usual = next((each for each in found if each.rank < chosen.rank and each.poses is chosen.poses), None)
        if usual and (text := self._fits_otherwise(usual, min(chosen.residual_px, LEAST_OFF_PX))):
            return text
        return "" if chosen.residual_px <= LEAST_OFF_PX else self._fits_otherwise(chosen, LEAST_OFF_PX)

    def _other_scale(self, chosen: Candidate) -> str:
        """The share of the ways that the poses state, by the height of the cameras above the road; "" if it is all."""
        if chosen.poses is None or len(self._pairs) < FEWEST_PAIRS or self._options.pose_unit is not None:
            return ""
        seen_m = self._height_seen(chosen)
        if seen_m is None:
            return ""
        height = self._options.height
        if isinstance(height, Mapping):
            height = float(np.mean([*height.values()]))
        scale = seen_m / max(height or float(np.mean(chosen.cameras[:, 2, 3])), 0.1)
        is_high = scale > OTHER_SCALE and (chosen.rig is None or height is not None)
        if not is_high and scale >= 1 / OTHER_SCALE:  # the origin of an open rig may be above the road, not below
            return ""
        return f"by the road in the images, the poses state {scale:.2f} of the ways that the vehicle drives"

    def _fits_otherwise(self, chosen: Candidate, most_px: float) -> str:
        """How the images would fit much better: with late poses, of another point, or without a lens; "" if not so.

        most_px: the largest residual of what fits.
        """
        points, reading = self._points, chosen.poses
        assert points is not None
        assert reading is not None
        track = _tracks(replace(self._poses, readings=(reading,)), self._times)[0]
        at = np.array([pair.times_ns for pair in self._pairs], dtype=np.int64)
        body = self._cameras(chosen.rig)[reading.camera] if reading.camera else np.eye(4)

        def residual_px(place: Array, late_ns: float = 0) -> float:
            steps = place @ body_motions(track.at(at - round(late_ns))[0]) @ inverse(place)
            return points.residual_px(chosen.cameras, steps)

        near = min(range(-LATEST_NS, LATEST_NS + 1, LATE_NS), key=partial(residual_px, body))
        late = minimize_scalar(
            partial(residual_px, body), bounds=(near - LATE_NS, near + LATE_NS), options={"xatol": LATE_WITHIN_NS}
        )
        changes = []
        if abs(late.x) >= LEAST_LATE_NS:
            word = "later" if late.x > 0 else "earlier"
            changes.append((late.fun, f"the poses are {abs(late.x) / 1e6:.0f} ms {word}"))
        if any(pair.camera.distortion for pair in self._pairs):
            without_lens = points.without_lens().residual_px(chosen.cameras, chosen.steps)
            changes.append((without_lens, "the images are rectified, without the lens distortion that is stated"))
        limits = {"initial_simplex": np.eye(4, 3, -1), "maxfev": TRIED_POINTS}
        best = minimize(
            lambda x: residual_px(rigid(x, body[:3, :3])), np.zeros(3), method="Nelder-Mead", options=limits
        )
        if np.linalg.norm(best.x) < FARTHEST_POINT_M:
            x, y, z = best.x
            place = f"the poses are of a point {x:.1f} m ahead, {y:.1f} left and {z:.1f} above the vehicle's origin"
            changes.append((best.fun, place))
        without, text = min(changes, default=(np.inf, ""))
        if chosen.residual_px <= OFF * without or without > most_px:
            return ""
        fit = f"fits the images by {chosen.residual_px:.1f} px, but by {without:.1f} px if {text}"
        return f"{reading.words()} {fit}"

    def _on_both_sides(self, left: Sequence[Candidate]) -> tuple[Candidate, str]:
        """The one of several axes of a rig in which most cameras have one like them on the other side of the vehicle.

        Raises InputError where more than these axes are open, or several are alike in this.
        """
        counts = [on_both_sides(each.rig.ego_from_camera) if each.rig else 0 for each in left]
        most = max(counts)
        are_axes = differing([each.whole for each in left]) == ["rig_axes"] and self._options.image_check
        if not are_axes or counts.count(most) > 1:
            raise self._question(left)
        chosen = left[counts.index(most)]
        others = [f"with {each.whole.flags(['rig_axes'])} {count}"
                  for each, count in zip(left, counts, strict=True) if each is not chosen]  # fmt: skip
        text = f"{most} of {len(self._draft.readings[0].ego_from_camera)} cameras are alike on both sides"
        return chosen, f"the images do not tell; {text}, {', '.join(others)}"

    def _question(self, left: Sequence[Candidate]) -> InputError:
        """The error that names the readings left, and the options that decide."""
        wholes = [each.whole for each in left]
        why = "the images do not tell which it is"
        if not self._options.image_check:
            why = "the images are not compared"
        elif not self._pairs:
            why += " (the vehicle does not move, or they show too little)"
        else:
            why += f" (residuals {left[0].residual_px:.1f} px, {left[1].residual_px:.1f} px)"
            why += f"; {contradiction}" if (contradiction := self.contradiction(left[0])) else ""
        return question(self._files(differing(wholes)), why, wholes)

    def _files(self, names: Sequence[str]) -> str:
        """The files that options state."""
        are_of_poses = {name.startswith("pose") for name in names}
        parts = ((self._draft, False), (self._poses, True))
        return " and ".join(str(part.file) for part, of_poses in parts if part.readings and of_poses in are_of_poses)

    def raised_by(self, chosen: Candidate) -> tuple[float, str]:
        """By how much the cameras are higher above the road than the file states, metres; and why, in words.

        Raises InputError where they may be higher, and the images do not tell.
        """
        assert chosen.rig is not None
        heights = [float(pose[2, 3]) for pose in chosen.rig.ego_from_camera.values()]
        up = self._missing_height(chosen)
        if up is None:
            if max(heights) > LOWEST_OF_GROUND_M and min(heights) > 0:
                return 0.0, ""
            raise InputError(
                f"{self._draft.file}: the cameras are {min(heights):.2f} to {max(heights):.2f} m above the origin, and "
                "the images do not tell its height: pass `--height 1.5` (`height`), the mean height of the cameras "
                f"above the road, or `--height {max(np.mean(heights), 0.1):.2f}` where the origin is on the road"
            )
        if not up:
            return 0.0, ""
        seen = f"{np.mean(heights) + up:.2f} m above the road"
        return up, f"; raised by {up:.2f} m, as the images show the cameras {seen}"

    def _missing_height(self, chosen: Candidate) -> float | None:
        """By how much the cameras are higher above the road than the file states, metres; None where it is not seen."""
        if (seen_m := self._height_seen(chosen)) is None:
            return None
        stated = float(np.mean(chosen.cameras[:, 2, 3]))
        up = seen_m - stated
        return up if abs(up) > max(SAME_HEIGHT_M, SAME_HEIGHT * stated) else 0.0

    def _height_seen(self, chosen: Candidate) -> float | None:
        """The mean height of the cameras above the road by the images, metres; None where it is not clear."""
        if self._points is None or self._poses.motion is None:
            return None
        if chosen not in self._heights:
            seen = height_above_road(self._points, chosen.cameras, chosen.steps)
            self._heights[chosen] = None if seen is None or seen.clearness < CLEAR_HEIGHT else seen.height_m
        return self._heights[chosen]


def _tracks(poses: ReadPoses, times_ns: NDArray[np.int64]) -> dict[int, Poses]:
    """The poses around the times (T,) by the index of their reading: a file may have many more."""
    motion = poses.motion
    if motion is None:
        return {}
    if not poses.readings:
        return {0: Poses.of(motion)}
    ends = times_ns.min() - AROUND_NS, times_ns.max() + AROUND_NS
    rows = slice(*(motion.timestamps_ns.searchsorted(ends) + (-1, 1)).clip(0))
    tracks = {}
    for index, reading in enumerate(poses.readings):
        at, quaternions = in_usual_axes(reading, rows)
        rotations = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
        tracks[index] = Poses(motion.timestamps_ns[rows], rotations, at)
    return tracks


def _is_possible(way: Array, times_ns: NDArray[np.int64]) -> bool:
    """False for a vehicle that moves aside, or faster than vehicles do."""
    seconds, lengths = (times_ns[:, 1] - times_ns[:, 0]) / 1e9, np.linalg.norm(way[:, :3, 3], axis=1)
    moving = lengths > MOVING_M_S * seconds
    if not moving.any():
        return True
    moved = way[moving, :3, 3]
    aside = np.arctan2(np.linalg.norm(moved[:, 1:], axis=1), np.abs(moved[:, 0]))
    return bool((lengths <= FASTEST_M_S * seconds)[moving].mean() > MOST_SLOW and np.median(aside) < ASIDE)
