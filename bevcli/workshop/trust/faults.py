"""`find_faults`: mistakes in the input, and broken weights or engines, that show without labels. One line each.

In this order: cameras that are dead or frozen, by their pixels; single cameras and poses, by how points move in the
images; an engine, by the boxes of PyTorch; colours and weights, by what the witness sees.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student_t

from bevcli.errors import Finding, errors_of
from bevcli.frame import Drive
from bevcli.geometry.boxes import Boxes2D, Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.inference import TORCH, run
from bevcli.inference.load import Model
from bevcli.recording.log_boxes import true_positives
from bevcli.sequences.open import select
from bevcli.workshop.formats.pose_readings import Poses
from bevcli.workshop.odometry.compare import chosen_frames, stated_motion_findings, stated_poses
from bevcli.workshop.odometry.step_views import Viewer
from bevcli.workshop.trust.agreement import FEWEST_OBJECTS, Held, compared
from bevcli.workshop.trust.camera_faults import camera_findings, points_of
from bevcli.workshop.trust.sightings import PARTNER
from bevcli.workshop.trust.witness import load_witness

STEPS = 6  # between frames whose images are compared
POSE_STEPS = 4  # between frames whose motion is measured
TRIED = 3, 18  # least frames and images in which the model's boxes are compared
SMALL = (64, 36)  # pixels of the images whose grey levels are compared
FLAT = 2.0  # grey levels: standard deviation of an image that shows something
STILL, MOVING = 0.05, 1.0  # change of a frozen image, as a share of the others'; least change of these, grey levels
SURE = 0.3  # score of boxes that are looked for
LEAST_SAME = 0.5  # share of such boxes that a sound engine gives
CLEAREST, CERTAIN = 3, 0.99  # objects of an image that tell its colours; Student's quantile that their gain exceeds
LEAST_FOUND = 0.3  # share of what the witness sees that sound weights find: 0.4 or more in 39 runs


def find_faults(model: Model, drive: Drive) -> tuple[Finding, ...]:
    """The faults of a drive that show without labels; none where all is sound.

    Findings of severity "info" say what could not be checked. A six-camera drive takes about 20 seconds on one core.

    Args:
        model: of `load_model`.
        drive: of `open_sequence`.

    Raises InputError where a frame cannot be read.
    """
    return (*input_faults(drive), *model_faults(model, drive))


def input_faults(drive: Drive) -> tuple[Finding, ...]:
    """Faults of cameras and poses, which need no model."""
    part, viewer = select(drive, chosen_frames(drive, STEPS)), Viewer()
    views, small = [], list[dict[str, Array]]()
    for place in range(len(part.stamps)):
        frame = part.load(place)
        views.append(viewer.view(frame))
        small.append({name: small_grey(image.pixels_bgr) for name, image in frame.images.items()})
    findings = image_findings(drive.rig.names, small)
    if not drive.has_ego_motion or len(views) < 2:
        return findings
    broken = {finding.camera for finding in findings}
    rows = Poses.of(stated_poses(part))
    points = [each for each in points_of(views, rows) if broken.isdisjoint(each.names)]
    interval_ns = int(np.median(np.diff([stamp.timestamp_ns for stamp in drive.stamps])))
    cameras = camera_findings(points, rows, views, interval_ns)
    measured = len({each.names[0] for each in points})
    return (*findings, *one_cause(stated_motion_findings(drive, POSE_STEPS), cameras, measured))


def one_cause(motion: tuple[Finding, ...], cameras: tuple[Finding, ...], measured: int) -> tuple[Finding, ...]:
    """The findings about poses or those about single cameras: few cameras that are off do not make poses wrong.

    Both of two cameras, or most of more, are hardly off at the same time: then nothing is said of them.
    """
    named = len(errors_of(cameras))
    if any(finding.severity != "info" for finding in motion):
        return cameras if 0 < named < measured / 2 else motion
    return motion if named > max(1, measured / 2) else (*motion, *cameras)


def small_grey(pixels_bgr: NDArray[np.uint8]) -> Array:
    """(h, w) grey levels of an image (H, W, 3), reduced to SMALL."""
    return cv2.cvtColor(cv2.resize(pixels_bgr, SMALL, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY).astype(float)


def image_findings(names: Iterable[str], frames: Sequence[dict[str, Array]]) -> tuple[Finding, ...]:
    """Cameras that show nothing, and those that stand still while the others move.

    frames: grey images (h, w) by camera, of successive frames.
    """
    findings, changes = list[Finding](), dict[str, float]()

    def add(code: str, name: str, message: str, found: str) -> None:
        findings.append(Finding(code, "error", name, message, found, "", "check the camera and its files"))

    for name in names:
        shown = [frame[name] for frame in frames if name in frame]
        if shown and max(image.std() for image in shown) < FLAT:
            levels = f"grey levels {min(map(np.min, shown)):.0f} to {max(map(np.max, shown)):.0f}"
            add("camera-dead", name, "its images show nothing", levels)
        elif len(shown) > 1:
            changes[name] = max(float(np.abs(b - a).mean()) for a, b in pairwise(shown))
    usual = float(np.median(list(changes.values()) or [0.0]))
    for name, change in changes.items():
        if usual >= MOVING and change < STILL * usual:
            found = f"grey levels change by {change:.2f} between frames, those of the other cameras by {usual:.1f}"
            add("camera-frozen", name, "its images are all the same", found)
    return tuple(findings)


def model_faults(model: Model, drive: Drive) -> tuple[Finding, ...]:
    """Faults that show in a few frames: a broken engine, exchanged colours, broken weights."""
    count = min(max(TRIED[0], -(-TRIED[1] // len(drive.rig.cameras))), len(drive.stamps))
    first = (len(drive.stamps) - count) // 2
    some = select(drive, range(first, first + count))
    steps = list(run(model, some, temporal=False, track=False))
    if broken := engine_findings(model, some, [one.boxes for _, one in steps]):
        return broken
    held = [(frame, one.boxes_world, load_witness().seen(frame)) for frame, one in steps]
    return (*color_findings(held), *weights_findings(model, held))


def engine_findings(model: Model, drive: Drive, boxes: Sequence[Boxes3D]) -> tuple[Finding, ...]:
    """The finding about an engine whose boxes are not those of PyTorch. boxes: those of the engine, by frame."""
    if not model.needs_export:  # PyTorch; or a file alone, whose network is not known
        return ()
    in_torch = replace(model, engine=TORCH, precision="fp32")
    plain = [one.boxes for _, one in run(in_torch, drive, temporal=False, track=False)]
    both = [side for side in (repeated(plain, boxes), repeated(boxes, plain)) if side[0]]
    count, same = min(both, key=lambda side: side[1], default=(0, 1.0))
    if same >= LEAST_SAME:
        return ()
    message = f"{model.engine} with {model.precision} does not give the boxes of PyTorch"
    advice = "export the model again, or use another precision or engine"
    found, expected = f"{same:.0%} of {count} boxes", f"{LEAST_SAME:.0%} or more"
    return (Finding("engine-broken", "error", None, message, found, expected, advice),)


def color_findings(frames: Iterable[Held]) -> tuple[Finding, ...]:
    """The finding about images whose red and blue are exchanged: the witness is surer in the other order."""
    gains = list[float]()
    for frame, _, as_stated in frames:
        images = {name: replace(one, pixels_bgr=one.pixels_bgr[..., ::-1]) for name, one in frame.images.items()}
        exchanged = load_witness().seen(replace(frame, images=images))
        gains += [_clearest(exchanged[name]) - _clearest(boxes) for name, boxes in (as_stated or {}).items()]
    if len(gains) < 2:
        return ()
    gain, deviation = float(np.mean(gains)), float(np.std(gains, ddof=1)) / len(gains) ** 0.5
    if gain <= student_t.ppf(CERTAIN, len(gains) - 1) * deviation:
        return ()
    found = f"the {CLEAREST} best scores of an image gain {gain:.2f} ± {deviation:.2f} with red and blue exchanged"
    message, advice = "red and blue are exchanged in the images", "state the order of the channels, or exchange them"
    return (Finding("color-order", "error", None, message, found, "", advice),)


def _clearest(boxes: Boxes2D) -> float:
    """Sum of the best scores of vehicles, people and cycles in an image."""
    return float(boxes.scores[boxes.classes != "traffic light"][:CLEAREST].sum())


def weights_findings(model: Model, frames: Iterable[Held]) -> tuple[Finding, ...]:
    """The finding about weights that find little of what the witness sees."""
    range_m, classes = model.config.bev_grid.nearest_side_m, model.config.object_classes
    seen = [one.sightings[one.sightings["is_seen"]] for one in compared(frames, classes, range_m, has_poses=False)]
    found = np.concatenate([each["overlap"][each["counted"]] >= PARTNER for each in seen])
    if len(found) < FEWEST_OBJECTS or found.mean() >= LEAST_FOUND:
        return ()
    message = "the model finds little of what a detector sees in the images"
    share, expected = f"{found.mean():.0%} of {len(found)} objects", f"{LEAST_FOUND:.0%} or more"
    advice = "take weights and model file of one training, check the engine, or use weights that know such images"
    return (Finding("weights-broken", "warning", None, message, share, expected, advice),)


def repeated(wanted: Sequence[Boxes3D], given: Sequence[Boxes3D]) -> tuple[int, float]:
    """Number of boxes with a score of 0.3 or more, or without one, and the share of them that others repeat.

    A box is repeated by one of its class that is at most 2 m away and has a score of 0.15 or more.
    """
    sides = zip(given, wanted, strict=True)
    found = np.concatenate([true_positives(others.scored(SURE / 2), boxes.scored(SURE))[1] for others, boxes in sides])
    return len(found), float(found.sum() / max(len(found), 1))
