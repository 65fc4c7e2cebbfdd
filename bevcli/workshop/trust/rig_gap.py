"""The gap of a rig, measured: the same rendered streets seen by the user's rig and by one that the weights know.

And by the user's rig with one difference taken back at a time. Boxes are kept in the user's cache, by weights and rig.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli._version import __version__
from bevcli.errors import InputError, OutputError
from bevcli.frame import CameraImage, Drive, Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.matching import DetectionConfig
from bevcli.geometry.object_classes import SHOWN_SCORE, ObjectClass
from bevcli.geometry.transforms import Array, inverse
from bevcli.inference.load import Model
from bevcli.inference.options import StepOptions
from bevcli.inference.preprocess import image_for_rig, network_scale
from bevcli.inference.runner import Runner
from bevcli.model.config import ImageConfig
from bevcli.rig.rig_checks import side_of
from bevcli.runs.state import digest, load_state, save_state
from bevcli.workshop.scores.bootstrap import draw_frames, resampled
from bevcli.workshop.scores.compare import Difference
from bevcli.workshop.scores.detection import DetectionScores, evaluate_detections
from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.corruptions import low_light
from bevcli.workshop.synth.drive import FIRST_TIMESTAMP_NS, RenderedDrive
from bevcli.workshop.trust.rig_differences import KnownRigs, RigDifference, taken_back
from bevcli.writing import user_cache

STREETS = (1_000_300, 1_000_313, 1_000_314, 1_000_315)  # busy ones, of three kinds of light, for evaluation only
FRAMES = 4  # of each street
SECTORS, RING_M = 16, 8.0  # of the polar map
RESAMPLES = 400
FORMAT = "rig-gap/1"  # of what is kept
MOST_EVERY = 4  # frames of the model's rate from one to the next, at a lower image rate
GREY_OF_LEVEL = {0: 37, 1: 31, 2: 25, 3: 19, 4: 14}  # mean grey of rendered streets at the levels of `low_light`
OF_DRIVE = ("rate", "light")  # kinds of differences that no rig has
ANY = "object"  # the class of all boxes together
RigBoxes = tuple[tuple[Boxes3D, Boxes3D], ...]  # predicted and true boxes of each frame, ego frame


@dataclass(frozen=True)
class Shot:
    """The streets seen by a rig.

    Attributes:
        rig: the cameras.
        frames: number of frames of each street.
        every: only every so many frames are taken: a lower image rate.
        darkness: a level of `low_light`; None for the light as it is.
    """

    rig: CameraRig
    frames: int = FRAMES
    every: int = 1
    darkness: int | None = None

    @property
    def count(self) -> int:
        """Number of frames of all streets."""
        return len(STREETS) * len(range(0, self.frames, self.every))

    def path(self, model: Model) -> Path:
        """The file in the user's cache that has the boxes of a model."""
        rig = [(c.width, c.height, c.intrinsics, c.ego_from_camera, c.distortion) for c in self.rig.cameras]
        how = (FORMAT, STREETS, self.frames, self.every, self.darkness)
        facts = (model.weights_hash, model.config_hash, model.precision, how, rig, self.rig.ego_from_bev)
        return user_cache() / "rig-gap" / f"{__version__}-{digest(facts)[:24]}.safetensors"


def boxes_of(model: Model, shot: Shot, after_frame: Callable[[], None] = lambda: None) -> RigBoxes:
    """The boxes of a model on the streets; those of an earlier call where the cache has them.

    Raises InputError for a lens that cannot be rendered.
    """
    path = shot.path(model)
    if path.exists():
        with suppress(InputError):  # damaged, or of another version
            return load_state(path, RigBoxes)
    runner, assets, boxes = model.runner(StepOptions(track=False)), Assets.build(), []
    for seed in STREETS:
        street = _Street(seed, shot, model.config.image, model.config.rate_hz, assets)
        for pair in _run(runner, street):
            boxes.append(pair)
            after_frame()
    with suppress(OutputError, OSError):  # the cache is not needed
        path.parent.mkdir(parents=True, exist_ok=True)
        save_state(path, tuple(boxes))
    return tuple(boxes)


def _run(runner: Runner, street: Drive) -> Iterator[tuple[Boxes3D, Boxes3D]]:
    for frame, prediction, _ in runner.run(street):
        assert frame.ground_truth is not None
        yield prediction.boxes_ego, frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix))


def trial(
    rig: CameraRig, differences: list[RigDifference], known: KnownRigs, range_m: float
) -> tuple[Shot, Shot] | tuple[()]:
    """The streets with differences of one kind, and with them taken back; () where they cannot be rendered."""
    kind, amount = differences[0].kind, differences[0].amount
    if kind == "rate":
        every = min(round(amount), MOST_EVERY)
        long = Shot(rig, 1 + (FRAMES - 1) * every)
        return replace(long, every=every), long
    if kind == "light":
        return Shot(rig, darkness=min(GREY_OF_LEVEL, key=lambda level: abs(GREY_OF_LEVEL[level] - amount))), Shot(rig)
    back = taken_back(rig, kind, known, range_m)
    return () if back is None else (Shot(rig), Shot(back))


def comparable(a: tuple[Shot, RigBoxes], b: tuple[Shot, RigBoxes]) -> tuple[RigBoxes, RigBoxes]:
    """The boxes of the frames that both shots have; of another rate without the first ones, which have no history."""
    every = max(a[0].every, b[0].every)
    if every == 1:
        return a[1], b[1]

    def common(shot: Shot, boxes: RigBoxes) -> RigBoxes:
        step, length = every // shot.every, len(boxes) // len(STREETS)
        return tuple(pair for k in range(len(STREETS)) for pair in boxes[k * length : (k + 1) * length][step::step])

    return common(*a), common(*b)


class _Street(Drive):
    """A rendered drive in memory, with images as large as the network takes them, or as the camera gives them."""

    def __init__(self, seed: int, shot: Shot, image: ImageConfig, rate_hz: float, assets: Assets) -> None:
        sized = image_for_rig(shot.rig, image)
        cameras = tuple(camera.scaled(min(1.0, network_scale(camera, sized))) for camera in shot.rig.cameras)
        self.rig = replace(shot.rig, cameras=cameras)
        self._drive = RenderedDrive(seed, shot.frames, rate_hz, self.rig, assets=assets, threads=2)
        self._motion, self._darkness = self._drive.ego_motion(), shot.darkness
        self.name, self.has_ego_motion = f"rendered-{seed}", True
        self._random = np.random.default_rng(seed)
        self.stamps = tuple(
            FrameStamp(index, self.name, FIRST_TIMESTAMP_NS + round(index * 1e9 / rate_hz))
            for index in range(0, shot.frames, shot.every)
        )

    def load(self, place: int) -> Frame:
        rendered = self._drive.frame(self.stamps[place].index)
        images = {
            name: CameraImage(rendered.camera_timestamps_ns[name], self._darkened(pixels))
            for name, pixels in rendered.images.items()
        }
        kinematics = self._motion.kinematics_at(rendered.stamp.timestamp_ns)
        poses = rendered.world_from_ego, rendered.world_from_ego_at
        return Frame(rendered.stamp, self.rig, images, *poses, kinematics, ground_truth=rendered.boxes)

    def _darkened(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return pixels if self._darkness is None else low_light(pixels, self._darkness, self._random)


@dataclass(frozen=True)
class Scored:
    """The scores of a rig on the streets.

    Attributes:
        together: all classes as one; a box of another class is none.
        by_class: each class alone.
        frames: number of frames.
    """

    together: DetectionScores
    by_class: DetectionScores
    frames: int

    @cached_property
    def values(self) -> dict[str, float]:
        """AP of all boxes together and of the first class, and mAP, by column of the table."""
        return _columns(self.together.overall.mean_ap, self.by_class.overall.of_classes_with_ground_truth())

    @cached_property
    def resampled(self) -> dict[str, Array]:
        """(RESAMPLES,) the values of each resample of the frames, by column; the same resamples for each rig."""
        draws = draw_frames(self.frames, RESAMPLES)
        parts = self.together.frame_count // self.frames  # a frame for each class
        tables = zip(
            resampled(self.together, np.repeat(draws, parts, axis=1)), resampled(self.by_class, draws), strict=True
        )
        rows = [_columns(all_boxes.mean_ap, each.of_classes_with_ground_truth()) for all_boxes, each in tables]
        return {name: np.array([row[name] for row in rows]) for name in self.values}

    @property
    def counts(self) -> dict[str, int]:
        """Number of objects, by column; mAP has none."""
        name, first = next(iter(self.by_class.overall.of_classes_with_ground_truth().classes.items()))
        return {"all boxes": self.together.overall.ground_truth_count, name: first.ground_truth_count}

    @property
    def places(self) -> Array:
        """(G, 2) x and y of the objects in the ego frame, metres."""
        return np.asarray(self.together.matches[0].ground_truth.boxes.centers[:, :2])

    @cached_property
    def found(self) -> NDArray[np.bool_]:
        """(G,) whether a shown box of its class is within 2 m of each object."""
        matches = self.together.matches[0]
        matched = matches.matched[self.together.config.error_row]
        hits = matched[(matched >= 0) & (matches.predictions.column("scores") >= SHOWN_SCORE)]
        return np.asarray(np.isin(np.arange(len(matches.ground_truth)), hits))

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """(G,) the number of the vehicle, person or thing, which is the same in all frames of a street."""
        truth = self.together.matches[0].ground_truth
        streets = truth.frames * len(STREETS) // self.together.frame_count
        names = [f"{street} {name}" for street, name in zip(streets, truth.column("instances"), strict=True)]
        return np.asarray(np.unique(names, return_inverse=True)[1])


def _columns(together: float, table: Any) -> dict[str, float]:
    first = next(iter(table.classes))
    return {"all boxes": together, first: table.classes[first].mean_ap, "mAP": table.mean_ap}


def seen_objects(*of_rigs: RigBoxes) -> tuple[set[str], ...]:
    """Of each frame, the objects of which any of the rigs sees a pixel."""
    return tuple({name for pair in pairs for name in _seen(pair[1])} for pairs in zip(*of_rigs, strict=True))


def _seen(true: Boxes3D) -> list[str]:
    assert true.instances is not None
    assert true.num_points is not None
    names: list[str] = true.instances[true.num_points > 0].tolist()
    return names


def scored(boxes: RigBoxes, seen: tuple[set[str], ...], classes: dict[str, ObjectClass], range_m: float) -> Scored:
    """The scores of the boxes on the objects of `seen_objects`, which are the same for all rigs."""
    predicted = [pair[0] for pair in boxes]
    true = [
        replace(truth[[name in names for name in np.asarray(truth.instances).tolist()]], num_points=None)
        for (_, truth), names in zip(boxes, seen, strict=True)
    ]
    one = DetectionConfig.of({ANY: ObjectClass(ANY, range_m)})
    together = evaluate_detections(_split(predicted, classes), _split(true, classes), one)
    by_class = evaluate_detections(predicted, true, DetectionConfig.of(classes).cut_at(range_m))
    return Scored(together, by_class, len(boxes))


def _split(frames: list[Boxes3D], classes: dict[str, ObjectClass]) -> list[Boxes3D]:
    """The boxes of each class as a frame of its own, so that boxes of different classes never match."""
    parts = (boxes[boxes.classes == name] for boxes in frames for name in classes)
    return [replace(part, classes=np.full(len(part), ANY)) for part in parts]


def difference(a: Scored, b: Scored, column: str = "all boxes") -> Difference:
    """The difference b - a of a column, with its 95 % interval over resamples of the frames."""
    low, high = np.nanpercentile(b.resampled[column] - a.resampled[column], [2.5, 97.5])
    return Difference((a.values[column], b.values[column]), (float(low), float(high)))


@dataclass(frozen=True)
class Cost:
    """What differences of one kind cost.

    Attributes:
        differences: of a rig.
        with_it: the scores with the differences; None where they cannot be rendered.
        without: the scores with them taken back.
    """

    differences: tuple[RigDifference, ...]
    with_it: Scored | None = None
    without: Scored | None = None

    @cached_property
    def gain(self) -> Difference | None:
        """AP of all boxes without the differences less that with them."""
        return difference(self.with_it, self.without) if self.with_it and self.without else None

    @property
    def text(self) -> str:
        """The AP that is lost, or that it is within noise."""
        if self.gain is None:
            return "not measured"
        low, high = self.gain.interval
        return f"{self.gain.difference:.2f} ({low:.2f} to {high:.2f})" if self.gain.better else "within noise"

    @property
    def label(self) -> str:
        """The row of `shown`: a rig has its differences, a drive's are added to it."""
        kind = self.differences[0].kind
        other = ", of other frames" * (kind == "rate")
        return f"with its {kind}{other}" if kind in OF_DRIVE else f"without its {kind}"

    @property
    def shown(self) -> Scored | None:
        """The scores that a rig does not have as it is."""
        return self.with_it if self.differences[0].kind in OF_DRIVE else self.without

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        values = {name: each and each.values for name, each in (("with", self.with_it), ("without", self.without))}
        differences = [vars(each) for each in self.differences]
        return {"differences": differences, "average_precision": values, "gain": self.gain and self.gain.to_dict()}


@dataclass(frozen=True)
class MeasuredRig:
    """A rig on the rendered streets, and what its differences cost."""

    name: str
    rig: CameraRig
    scored: Scored
    costs: tuple[Cost, ...] = ()

    def to_dict(self, range_m: float) -> dict[str, Any]:
        """For JSON."""
        return {
            "average_precision": self.scored.values,
            "found": float(self.scored.found.mean()),
            "found_by_sector_and_ring": polar_map(self.scored.places, self.scored.found, range_m).found.tolist(),
            "costs": [cost.to_dict() for cost in self.costs],
        }


@dataclass(frozen=True)
class PolarMap:
    """Objects by direction and distance, and how many of them are found.

    Attributes:
        counts: (SECTORS, R) number of objects. Sector 0 is ahead, further ones are counter-clockwise.
        found: (SECTORS, R) how many are found.
    """

    counts: NDArray[np.int64]
    found: NDArray[np.int64]


def cells_of(places: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sector and ring (G,) of places (G, 2), metres in the ego frame."""
    turn = 2 * np.pi / SECTORS
    sectors = np.round(np.arctan2(places[:, 1], places[:, 0]) / turn).astype(np.int64) % SECTORS
    return sectors, (np.hypot(*places.T) // RING_M).astype(np.int64)


def polar_map(places: Array, found: NDArray[np.bool_], range_m: float) -> PolarMap:
    """The map of objects at places (G, 2), metres in the ego frame, of which some are found (G,)."""
    shape, cells = (SECTORS, int(np.ceil(range_m / RING_M))), np.stack(cells_of(places))
    counts, hits = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    np.add.at(counts, tuple(cells), 1)
    np.add.at(hits, tuple(cells[:, found]), 1)
    return PolarMap(counts, hits)


def sides(a: Scored, b: Scored) -> Iterator[tuple[str, int, float, float]]:
    """The sides on which b finds another share than a, beyond noise: side, number of objects, and both shares."""
    names = np.array([side_of(float(yaw)) for yaw in np.degrees(np.arctan2(a.places[:, 1], a.places[:, 0]))])
    for side in dict.fromkeys(names.tolist()):
        mine = names == side
        if is_clear(a, b, mine):
            yield side, int(mine.sum()), float(a.found[mine].mean()), float(b.found[mine].mean())


def is_clear(a: Scored, b: Scored, weights: Array | NDArray[np.bool_] | float = 1.0) -> bool:
    """Whether b finds more or fewer objects than a, beyond noise.

    What one object changes in all frames together counts as one draw: the sum is compared with two of its standard
    deviations, if the sign of each were chance. weights: (G,) of the objects.
    """
    changes = np.bincount(a.objects, weights * (b.found.astype(float) - a.found))
    return bool(abs(changes.sum()) > 2 * np.sqrt((changes**2).sum()))
