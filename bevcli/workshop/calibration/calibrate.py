"""`calibrate`: a drive -> how far its calibration is off, from what its images show between two frames.

In this order: the rounds of the measurement, rotations from matched points and heights from the road; the verdicts.
`motion_steps` is the same in short, as findings for `bevcli project-debug`.
"""

import json
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bevcli.errors import Finding, InputError
from bevcli.frame import Drive, DriveFacts
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array
from bevcli.options import gather
from bevcli.printing import aligned
from bevcli.sequences.files.calibration_file import write_calibration
from bevcli.workshop.calibration import CalibrateOptions
from bevcli.workshop.calibration.estimates import (
    CERTAIN_DELAY,
    HEADER,
    HEIGHT,
    MEASURED_MOTION,
    OF_CAMERA,
    OF_RIG,
    CameraEstimate,
    RigEstimate,
    Unknowns,
    Verdict,
    change_text,
    common_delay_text,
    delay_text,
    either_text,
    moved,
    rig_text,
    row,
    with_estimated_turns,
)
from bevcli.workshop.calibration.road import followed, level_corrections, road_residuals, search_heights, sees_road
from bevcli.workshop.calibration.views import (
    FEWEST_PAIRS,
    READING_STEPS,
    PointMatches,
    Views,
    depths_of,
    match_points,
    read_views,
    unknowns_of,
)
from bevcli.workshop.correspondence.images import WIDTH
from bevcli.workshop.correspondence.residuals import (
    DepthResiduals,
    RoadResiduals,
    Solution,
    Term,
    geometry_at,
    honest_covariance,
    solve,
    spread,
    values,
)
from bevcli.writing import write_whole

Result = TypeVar("Result")
EVEN_MS = 0.01  # largest difference of intervals between frames that are the same
SCALES_PX = (20.0, 5.0, 1.5, 0.7)  # of Cauchy's loss for points, one search after the other
POINT_SCALE_PX, ROAD_SCALES_PX = 0.3, (3.0, 1.0, 0.5)  # then: the smallest one, and those of road points
CONSISTENT_PX, CONSISTENT_SHARE = 5.0, 0.5  # of the points of a pair of images: residual, and share of all
TURN_ROUNDS = 4  # in which the error of the vehicle's rotation is estimated
KERB_M = 0.09  # less than from the road to a pavement
LEAST_SHOWN = 0.7  # of a wrong roll, that the road has to show
LEAST_SIGNAL = 16.0  # of contrast over noise, for cameras whose road shows less
FLOWS_PX = (12.0, 8.0)  # largest distance of road points from where they are expected, round by round
PARTS = 2 + len(FLOWS_PX)  # of the work, for progress


@dataclass(frozen=True)
class Measurement:
    """What the drive says about the unknowns."""

    views: Views
    matches: PointMatches  # of all pairs
    unknowns: Unknowns
    solution: Solution
    points: PointMatches  # the matches that were used
    road: RoadResiduals


def measure(views: Views, matches: PointMatches, options: CalibrateOptions) -> Generator[None, None, Measurement]:
    """Measure all unknowns: yields PARTS times on the way, and returns the measurement."""
    unknowns = unknowns_of(views, options)
    within, x = matches.where(matches.same), np.zeros(len(unknowns.deviations))
    for scale in SCALES_PX:
        x = solve(unknowns, [(within, scale)], x).x
    at_once, depths = matches.where(~matches.moves), depths_of(unknowns, matches)
    for scale in SCALES_PX if len(at_once.group) else ():
        x = solve(unknowns, [(within, SCALES_PX[-1]), (at_once, scale), (depths, scale)], x).x
    points = consistent(unknowns, matches.where(matches.same | ~matches.moves), x)
    yield
    heights = np.arange(unknowns.cameras) * OF_CAMERA + HEIGHT
    x[heights] += search_heights(views, unknowns, x)
    yield
    ties, signals, roadless = matches.where(~matches.same & matches.moves), np.zeros(unknowns.cameras), x
    while True:
        x = roadless
        for most_px in FLOWS_PX:
            x, road = _with_road(views, unknowns, x, (points, depths, ties), most_px, signals)
            if not signals.any():
                yield
        shown = followed(views, unknowns, x, FLOWS_PX[0], signals)
        unsure = (shown < LEAST_SHOWN) & (signals == 0)
        if not unsure.any():
            break
        signals = np.where(unsure, LEAST_SIGNAL, signals)
    sees = sees_road(unknowns, road, ties, x) & (shown >= LEAST_SHOWN)
    road = road.where(sees[unknowns.groups[road.group, 1]])
    for _ in range(TURN_ROUNDS):
        solution = solve(unknowns, _terms(unknowns, (points, depths, road), x, ROAD_SCALES_PX[-1]), x)
        x, unknowns = solution.x, with_estimated_turns(unknowns, solution)
    return Measurement(views, matches, unknowns, solution, points, road)


def _with_road(
    views: Views,
    unknowns: Unknowns,
    x: Array,
    matches: tuple[PointMatches, DepthResiduals, PointMatches],
    most_px: float,
    signals: Array,
) -> tuple[Array, RoadResiduals]:
    """x (P,) and the points of the road, of one round from x.

    matches: points of one camera or of one frame, their depths, and points of neighbours in two frames.
    most_px: of FLOWS_PX; the first round also puts cameras on the level of the road. signals: see `road_residuals`.
    """
    points, depths, ties = matches
    road = road_residuals(views, unknowns, x, most_px, signals)
    for scale in ROAD_SCALES_PX:
        x = solve(unknowns, _terms(unknowns, (points, depths, road), x, scale), x).x
    if most_px == FLOWS_PX[0]:
        levels = level_corrections(unknowns, road, ties, x)
        x = x + levels
        # Shared points tell the level, and the road then tells the height to the step of the search.
        heights = np.arange(unknowns.cameras) * OF_CAMERA + HEIGHT
        x[heights] += search_heights(views, unknowns, x, levels[heights] != 0, KERB_M)
    return x, road


def _terms(
    unknowns: Unknowns,
    measured: tuple[PointMatches, DepthResiduals, RoadResiduals],
    x: Array,
    road_scale: float,
) -> list[Term]:
    """All kinds of residuals, with the spread that they have at x (P,)."""
    terms: list[Term] = []
    for residuals, least in zip(measured, (POINT_SCALE_PX, POINT_SCALE_PX, road_scale), strict=True):
        cameras = unknowns.groups[residuals.group, 1:] @ np.array([1, unknowns.cameras])
        terms.append((residuals, np.maximum(least, spread(unknowns, residuals, x, cameras))))
    return terms


def consistent(unknowns: Unknowns, points: PointMatches, x: Array) -> PointMatches:
    """The points that fit at x (P,), of the image pairs in which most of them do.

    Repeated texture gives pairs whose matches fit a motion, but not that of the vehicle.
    """
    fits = np.abs(values(unknowns, points, x)[:, 0]) < CONSISTENT_PX
    count = len(unknowns.groups)
    fitting, matched = (np.bincount(group, minlength=count) for group in (points.group[fits], points.group))
    shares = fitting / np.maximum(matched, 1)
    return points.where(fits & (shares[points.group] >= CONSISTENT_SHARE))


FEWEST_MATCHES = 100  # of a camera
WIDEST_DEG = 0.3  # deviation of a rotation that counts as measured
LEAST_TURNED_DEG = 20.0  # of the vehicle, see `_turned_deg`; points then tell a rotation about its way, too
MOSTLY = 0.7  # cosine between an axis of a camera and the way
FINE = np.array([np.radians(0.2)] * 3 + [0.03, 0.03, 0.015])  # changes that are not worth a correction,
FINE_DEVIATIONS = 4.0  # or less than this many standard deviations: where few pairs agree by chance, 3.6 were seen
LEAST_INFORMATION = 3.0  # of a direction, in that of the stated value: the deviation is then halved at least
FINEST = np.array([np.radians(0.01)] * 3 + [0.001] * 3 + [0.001])  # errors of lens and images: radians, metres, seconds
STEPS = READING_STEPS + 1 + PARTS + 1  # of `calibration_steps`
SHORT_PAIRS = 8  # of frames, for findings


@dataclass(frozen=True)
class CalibrationResult:
    """The result of `calibrate`."""

    name: str  # of the drive
    stated: CameraRig  # the rig of the drive
    rig: CameraRig  # the corrected rig; cameras that are fine or not measurable are as stated
    cameras: tuple[CameraEstimate, ...]  # in the rig's order
    whole: RigEstimate  # what is said about the whole rig
    pairs: int  # number of frame pairs that were used
    facts: DriveFacts  # of the drive, for calibration.json
    # Between frames, if it is the same for all: such times are often nominal. None if it is not.
    interval_ms: float | None = None
    rounds: int = 0  # in which its motion was measured too (`calibrate_in_turn`); 0 if the motion is stated
    # Direction of the measured motion, degrees to the left of x, and its deviation.
    drives_beside_x_deg: tuple[float, float] = (0.0, 0.0)

    def __getitem__(self, camera: str) -> CameraEstimate:
        return next(estimate for estimate in self.cameras if estimate.camera == camera)

    def text(self) -> str:
        """One row a camera, and lines about the whole rig, for a terminal."""
        pairs = f"{self.name}: {self.pairs} frame pairs; off by: stated minus measured, ± standard deviation"
        table = aligned([HEADER, *map(row, self.cameras)], left=(0, 9))
        yaw, deviation = self.drives_beside_x_deg
        measured = [MEASURED_MOTION.format(rounds=self.rounds, yaw=yaw, deviation=deviation)] if self.rounds else []
        return "\n".join([table, "", pairs, rig_text(self.whole, self.cameras, self.interval_ms), *measured])

    def to_json(self) -> str:
        """The content of report.json."""
        content: dict[str, Any] = {
            "drive": self.name,
            "pairs": self.pairs,
            "cameras": {estimate.camera: estimate.to_dict() for estimate in self.cameras},
            "rig": asdict(self.whole),
        }
        if self.rounds:
            content |= {"rounds": self.rounds, "drives_beside_x_deg": self.drives_beside_x_deg}
        return json.dumps(content, indent=1, ensure_ascii=False)

    def write(self, folder: Path | str) -> list[Path]:
        """Write calibration.json (the corrected rig) and report.json into a folder. Returns their paths.

        The folder is made where it is missing; existing files are overwritten. Raises OutputError.
        """
        rig, report = Path(folder) / "calibration.json", Path(folder) / "report.json"
        write_whole(report, f"{self.to_json()}\n".encode(), parents=True)
        write_calibration(rig, self.rig, self.facts)
        return [rig, report]


def calibrate(drive: Drive, options: CalibrateOptions | None = None, **changes: Any) -> CalibrationResult:
    """Measure the calibration of a drive from its own images and ego-motion.

        result = calibrate(open_sequence("my_drive"))
        print(result.text())
        result.write("rig")

    What the images show between two frames must fit how the vehicle moved. Matched points tell the rotation of each
    camera, and its position where the drive turns; the flat road tells its height, pitch and roll. All are estimated
    together, about the stated values. What the drive does not show stays as it is stated.

    Args:
        drive: of `open_sequence`, one scene with ego-motion.
        options: see `CalibrateOptions`.
        changes: options as keywords.

    Raises InputError where the drive does not show how its cameras move: no ego-motion, too few frames, a vehicle that
    stands, black images, or several scenes.
    """
    return last(calibration_steps(drive, gather(CalibrateOptions, options, changes)))


def last(steps: Iterable[Result | None]) -> Result:
    """The result of all steps of some work."""
    *_, result = steps
    assert result is not None
    return result


def calibration_steps(drive: Drive, options: CalibrateOptions) -> Iterator[CalibrationResult | None]:
    """`calibrate` in STEPS parts: None after each of them but the last, then the result."""
    views = yield from read_views(drive, options.pairs)
    matches = match_points(views)
    yield None
    if not matches.same.any():
        raise InputError(
            f"{drive.name}: no points were found in both frames of a pair (expected {FEWEST_MATCHES} or more a "
            "camera): choose a part of the drive in which the images are sharp and show something"
        )
    measurement = yield from measure(views, matches, options)
    yield judge(drive, measurement)


def judge(drive: Drive, measurement: Measurement) -> CalibrationResult:
    """The result of a measurement: what is observed, with a verdict for each camera."""
    changes, covariances, whole = observed(measurement)
    stated_rig, unknowns, pairs = measurement.views.stated, measurement.unknowns, len(measurement.views.pairs)
    cameras = tuple(_estimate(index, measurement, changes[index], covariances[index]) for index in range(len(changes)))
    corrected = tuple(
        replace(camera, ego_from_camera=pose) if estimate.verdict is Verdict.CORRECTED else camera
        for camera, pose, estimate in zip(stated_rig.cameras, moved(unknowns.stated, changes), cameras, strict=True)
    )
    rig = replace(stated_rig, cameras=corrected)
    steps_ms = np.diff([stamp.timestamp_ns for stamp in drive.stamps]) / 1e6
    interval_ms = float(np.median(steps_ms)) if len(steps_ms) and np.ptp(steps_ms) < EVEN_MS else None
    return CalibrationResult(drive.name, stated_rig, rig, cameras, whole, pairs, drive.facts, interval_ms)


def _estimate(index: int, measurement: Measurement, change: Array, covariance: Array) -> CameraEstimate:
    """change, covariance: of `observed`, (7,) and (7, 7)."""
    views, groups = measurement.views, measurement.matches.group
    deviations = np.sqrt(np.diag(covariance))
    mine = (measurement.unknowns.groups[groups, 1:] == index).all(-1)
    count, pairs = int(mine.sum()), len(np.unique(groups[mine]))
    turned_deg = _turned_deg(measurement.unknowns)
    reason = _reason(count, pairs, np.degrees(deviations[:3]), views.stated.cameras[index], turned_deg)
    enlarged = views.stated.cameras[index].width / views.rig.cameras[index].width
    solution = measurement.solution.x
    before, after = (_residual_px(measurement, index, x) * enlarged for x in (0 * solution, solution))
    road = measurement.unknowns.groups[measurement.road.group, 1] == index
    fine = np.abs(change[:6]) <= np.maximum(FINE, FINE_DEVIATIONS * deviations[:6])
    verdict = Verdict.FINE if fine.all() else Verdict.CORRECTED
    return CameraEstimate(
        camera=views.rig.names[index],
        verdict=Verdict.NOT_MEASURABLE if reason else verdict,
        reason=reason,
        rotation_deg=_yaw_pitch_roll(-np.degrees(change[:3])),
        rotation_deviation_deg=_yaw_pitch_roll(np.degrees(deviations[:3]) * [1, -1, 1]),
        position_m=tuple((-change[3:6]).tolist()),
        position_deviation_m=tuple(deviations[3:6].tolist()),
        delay_ms=1000 * float(change[6]),
        delay_deviation_ms=1000 * float(deviations[6]),
        matches=count,
        road_points=int(road.sum()),
        before_px=before,
        after_px=after,
        change=change,
        covariance=covariance,
    )


def _reason(
    matches: int, pairs: int, deviations_deg: Array, camera: Camera, turned_deg: float = LEAST_TURNED_DEG
) -> str:
    """Why a camera is not measurable, with the size of images or the drive that would do; "" where it is.

    turned_deg: see `_turned_deg`.
    """
    # Matches grow with the area of an image, deviations shrink with its width.
    widest = deviations_deg.max()
    width_px = camera.width * max(np.sqrt(FEWEST_MATCHES / max(matches, 1)), widest / WIDEST_DEG)
    width = int(min(WIDTH, 10 * np.ceil(width_px / 10)))
    height = round(camera.height * width / camera.width)
    pixels = f"{camera.width} x {camera.height}"
    size = f"; its images are {pixels}: about {width} x {height} would do" if width > camera.width else ""
    if matches < FEWEST_MATCHES:
        return f"{matches} matches{size}"
    if pairs < FEWEST_PAIRS:
        return f"matches in {pairs} frame pairs"
    if widest <= WIDEST_DEG:
        return ""
    shown = f"the drive shows its rotation to ±{widest:.1f}° only"
    ahead = np.abs(camera.ego_from_camera[0, :3])  # the direction in which the vehicle drives, in the camera frame
    if turned_deg < LEAST_TURNED_DEG and ahead[deviations_deg.argmax()] > MOSTLY:
        return f"{shown}: the road shows too little, and the vehicle turns too little; a turn at a junction would do"
    if width_px > WIDTH > camera.width:
        deg = widest * camera.width / WIDTH
        size = f"; its images are {pixels}: {width} x {height} would show about ±{deg:.1f}°, and a longer drive less"
    return f"{shown}{size}"


def _turned_deg(unknowns: Unknowns) -> float:
    """The turns of the vehicle in all pairs, as the square root of their sum of squares.

    The error of the stated rotation of a pair looks like a rotation of the camera by that error over the turn.
    """
    motion = geometry_at(unknowns, np.zeros(len(unknowns.deviations))).ego_b_from_ego_a
    turns = np.arctan2(motion[:, 1, 0], motion[:, 0, 0])
    _, first = np.unique(unknowns.turns[unknowns.moves], return_index=True)
    return float(np.degrees(np.linalg.norm(turns[unknowns.moves][first])))


def _residual_px(measurement: Measurement, index: int, x: Array) -> float:
    mine = (measurement.unknowns.groups[measurement.points.group, 1:] == index).all(-1)
    residuals_px = np.abs(values(measurement.unknowns, measurement.points, x)[mine])
    return float(np.median(residuals_px)) if residuals_px.size else 0.0


def _yaw_pitch_roll(turn: Array) -> tuple[float, float, float]:
    """Small turns (3,) about right, down and forward axes of a camera as yaw (to the left), pitch (up) and roll."""
    return -float(turn[1]), float(turn[0]), float(turn[2])


def observed(measurement: Measurement) -> tuple[Array, Array, RigEstimate]:
    """The changes along directions that the drive shows, with their covariance; all else stays as it is stated.

    Returns:
        (C, 7) rotation, radians in the camera frame; position, metres in the ego frame; delay, seconds.
        (C, 7, 7) covariances of them; a direction that is not observed has the deviation of the stated value.
        The whole rig.
    """
    unknowns, solution = measurement.unknowns, measurement.solution
    deviations, count = unknowns.deviations, OF_CAMERA * unknowns.cameras
    covariance = honest_covariance(unknowns, solution, unknowns.groups[:, 0])
    scale = deviations[:count]
    marginal = np.linalg.inv(covariance[:count, :count] / np.outer(scale, scale)) - np.eye(count)
    sizes, axes = np.linalg.eigh((marginal + marginal.T) / 2)
    seen, unseen = axes[:, sizes >= LEAST_INFORMATION], axes[:, sizes < LEAST_INFORMATION]
    change = scale * (seen @ (seen.T @ (solution.x[:count] / scale)))
    within = seen @ np.diag(1 / (1 + sizes[sizes >= LEAST_INFORMATION])) @ seen.T + unseen @ unseen.T
    whole = np.outer(scale, scale) * within + np.diag(np.tile(FINEST, unknowns.cameras) ** 2)
    blocks = whole.reshape(unknowns.cameras, OF_CAMERA, unknowns.cameras, OF_CAMERA)
    changes = unknowns.of_camera(change)
    of_rig, of_rig_deviations = solution.x[-OF_RIG:], np.sqrt(np.diag(covariance)[-OF_RIG:])
    (along, across), (along_deviation, across_deviation) = np.degrees([of_rig[1:], of_rig_deviations[1:]]).tolist()
    rig = RigEstimate(
        scale=float(of_rig[0]),
        scale_deviation=float(of_rig_deviations[0]),
        height_m=-float(changes[:, HEIGHT].mean()),
        height_deviation_m=float(np.sqrt(blocks[:, HEIGHT, :, HEIGHT].sum()) / unknowns.cameras),
        tilt_deg=(along, across),
        tilt_deviation_deg=(along_deviation, across_deviation),
    )
    return changes, np.stack([blocks[c, :, c] for c in range(unknowns.cameras)]), rig


def motion_steps(drive: Drive) -> Iterator[tuple[Finding, ...] | None]:
    """Findings about the cameras whose calibration does not fit how the vehicle moves, measured from a few frames.

    In STEPS parts: None after each of them but the last, then the findings.
    """
    try:
        for result in calibration_steps(drive, CalibrateOptions(pairs=SHORT_PAIRS)):
            yield None if result is None else findings_of(result.cameras, result.interval_ms)
    except InputError as error:
        yield (Finding("motion-not-measured", "info", None, f"the drive does not show its calibration: {error}"),)


SOUND_STEPS = READING_STEPS + 2  # of `sound_steps`
SOUND_WIDTH = 800  # pixels, of the images: two thirds of the time of larger ones
SOUND = 0.75  # share of the limits of findings within which nothing else is measured
SOUND_FINE = 2.0  # times FINE, however wide the deviation: so few frames do not measure every camera
SURE_SHARES = 0.7, 0.5  # of the matches, that fit as stated: of each pair, of each camera
SURE_POINTS = 20  # of the road, of each pair but one: a vehicle that slows down or turns hardly shows it
SURE_HEIGHT_M = 0.02  # deviation of the mean height, which also tells the scale of the poses


def sound_steps(drive: Drive) -> Iterator[bool | None]:
    """Whether the images of a few frames fit the stated poses and calibration well, by one search from these.

    In SOUND_STEPS parts: None after each of them but the last, then False where `motion_steps` has to tell more.
    """
    try:
        views = yield from read_views(drive, SHORT_PAIRS, SOUND_WIDTH)
    except InputError:
        yield False
        return
    views = replace(views, apart=True)
    matches = match_points(views)
    yield None
    unknowns = unknowns_of(views, CalibrateOptions(pairs=SHORT_PAIRS))
    x = np.zeros(len(unknowns.deviations))
    points = consistent(unknowns, matches, x)
    road = road_residuals(views, unknowns, x, FLOWS_PX[-1], np.zeros(unknowns.cameras))
    # Most matches of each pair and camera fit where it turns as stated, and its road where it moves as far.
    is_fit = [
        (np.bincount(of[points.group], minlength=n) >= share * np.bincount(of[matches.group], minlength=n)).all()
        for of, n, share in zip(unknowns.groups.T, (unknowns.pairs, unknowns.cameras), SURE_SHARES, strict=False)
    ]
    on_road = np.bincount(unknowns.groups[road.group, 0], minlength=unknowns.pairs)
    if not all(is_fit) or np.sort(on_road)[:2].max() < SURE_POINTS:
        yield False
        return
    terms = _terms(unknowns, (points, depths_of(unknowns, matches), road), x, ROAD_SCALES_PX[-1])
    yield _is_sound(judge(drive, Measurement(views, matches, unknowns, solve(unknowns, terms, x), points, road)))


def _is_sound(result: CalibrationResult) -> bool:
    """True where most cameras are measured, and all are far from what would be a finding."""
    change = np.abs([estimate.change for estimate in result.cameras])
    deviations = np.sqrt([np.diag(estimate.covariance) for estimate in result.cameras])
    certain, least_ms = CERTAIN_DELAY
    limits = np.maximum([*FINE, least_ms / 1000], deviations * [*[FINE_DEVIATIONS] * len(FINE), certain]) * SOUND
    limits[:, : len(FINE)] = np.minimum(limits[:, : len(FINE)], SOUND_FINE * FINE)
    measured = sum(estimate.verdict is Verdict.FINE for estimate in result.cameras)
    is_sure = result.whole.height_deviation_m < SURE_HEIGHT_M and not findings_of(result.cameras, result.interval_ms)
    return is_sure and 2 * measured > len(result.cameras) and bool((change <= limits).all())


def findings_of(cameras: Sequence[CameraEstimate], interval_ms: float | None = None) -> tuple[Finding, ...]:
    """A finding for each camera that is corrected, and for each whose capture times are off, or one for all.

    interval_ms: see `CalibrationResult`.
    """
    findings, common = [], common_delay_text(cameras, interval_ms)
    if common:
        advice = "correct the timestamps of the images or those of the poses"
        findings.append(Finding("capture-times-off", "warning", None, common, "", "", advice))
    for estimate in cameras:
        name = estimate.camera
        if estimate.verdict is Verdict.CORRECTED:
            message, advice = "does not fit how the vehicle moves", "measure it with `bevcli calibrate`"
            findings.append(Finding("calibration-off", "warning", name, message, change_text(estimate), "", advice))
        if delay_text(estimate) and not common:
            late = f"{estimate.delay_ms:+.0f} ms ± {estimate.delay_deviation_ms:.0f} ms"
            message, advice = "its images were taken at another time than stated", "correct its timestamps"
            findings.append(Finding("capture-times-off", "warning", name, message, late, "0 ms", advice))
        if either_text(estimate):
            advice = "choose a part of the drive that turns and drives straight on"
            findings.append(Finding("capture-times-off", "warning", name, either_text(estimate), "", "", advice))
    return tuple(findings)
