"""Tracking: boxes get identities over time, by greedy matching of centres that move with the predicted velocity.

The matching is that of CenterPoint (Yin et al., Center-based 3D Object Detection and Tracking, CVPR 2021, section 4.3):
the tracks move to the frame's time, and the boxes, highest score first, each take the nearest free track of their class
within the class's gate. Added here: two score thresholds, scores of tracks, the suppression of duplicates, and the
velocities of boxes that have none of their own, as those that a detector finds in single images.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import FrameStamp, Prediction
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array, inverse
from bevcli.parsing.documents import Count, NotNegative, Positive, Share

OTHER = "other"  # the gate of classes that have none
LEAST_SHARE = 0.2  # of a step in the velocity of a track whose boxes have none
SLOW_MPS = 0.8  # below which such a track may as well stand, twice this after one step: its boxes keep their 0
FIRST_GATE = 1.6  # times the gate where no velocity is known yet


@dataclass(frozen=True)
class TrackerConfig:
    """The parameters of the tracker: the table [tracking] of a model's TOML file."""

    birth_score: Share = 0.2  # an unmatched box with this score or more starts a track
    keep_score: Share = 0.1  # a box with this score or more can continue a track
    confirm_frames: Count = 2  # number of frames with a box after which a track is confirmed
    # time that a confirmed track lives without a box, in seconds. Other tracks end with the first frame without a box
    coast_s: NotNegative = 1.5
    carry_s: NotNegative = 3.0  # time that a track lives on boxes where no camera looks, in seconds
    # a box is a duplicate when the centre of a better box of its class is closer than this many widths of the better
    # box. 0: no box is a duplicate
    duplicate_widths: NotNegative = 1.0
    # whether tracks move with the predicted velocity; if not, they stay where their last box is
    use_velocity: bool = True
    # the largest distance of a match, by class, "other" for other classes, 4 m if left out. `for_classes` adds those of
    # a model's classes
    gates_m: Mapping[str, Positive] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.keep_score > self.birth_score:
            found = f"{self.keep_score:g} and {self.birth_score:g}"
            raise ValueError(f"keep_score must not be above birth_score; found {found}")

    def for_classes(self, classes: Mapping[str, ObjectClass]) -> "TrackerConfig":
        """The parameters with a gate for each of a model's classes. Raises ValueError for a gate of no class."""
        unknown = self.gates_m.keys() - {OTHER, *classes, *NUSCENES_CLASSES}
        if unknown:
            raise ValueError(f'gates_m.{min(unknown)}: the model has no class "{min(unknown)}"')
        return replace(self, gates_m={name: of_class.gate_m for name, of_class in classes.items()} | dict(self.gates_m))


@dataclass(frozen=True)
class Tracks:
    """T tracks in the world frame.

    Attributes:
        numbers: (T,) identity.
        classes: (T,) names.
        centers_xy: (T, 2) centre of the last box, metres.
        velocities: (T, 2) velocity of the last box, or by its steps, m/s. 0 where it is unknown.
        seen_ns: (T,) time of the last box.
        in_view_ns: (T,) time of the last box where a camera looked.
        frames: (T,) number of frames with a box.
        score_sums: (T,) sum of the scores of these boxes.
    """

    numbers: NDArray[np.int64]
    classes: NDArray[np.str_]
    centers_xy: Array
    velocities: Array
    seen_ns: NDArray[np.int64]
    in_view_ns: NDArray[np.int64]
    frames: NDArray[np.int64]
    score_sums: Array

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, selection: NDArray[Any]) -> "Tracks":
        """The tracks of a mask (T,) bool or of an index array."""
        return Tracks(*(getattr(self, column.name)[selection] for column in fields(self)))

    @staticmethod
    def empty() -> "Tracks":
        """No track at all."""
        nothing, no_numbers = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
        times = no_numbers, no_numbers, no_numbers
        return Tracks(no_numbers, np.zeros(0, "<U1"), nothing, nothing, *times, np.zeros(0))


@dataclass(frozen=True)
class TrackerState:
    """All that the tracker keeps from one frame to the next."""

    tracks: Tracks  # the tracks that live
    stamp: FrameStamp  # of the last frame
    next_number: int  # the identity of the next track. It never falls, so that identities differ between scenes, too


def track(
    config: TrackerConfig, state: TrackerState | None, prediction: Prediction
) -> tuple[TrackerState | None, Prediction]:
    """The state after a frame, and its prediction whose boxes have their identities: see `step`.

    A frame without any image has no boxes and leaves the state as it is.
    """
    if prediction.skipped:
        return state, prediction
    state, tracked = step(config, state, prediction.boxes_world, prediction.stamp)
    columns = {name: getattr(tracked, name) for name in ("instances", "track_scores", "duplicates")}
    own = prediction.boxes.velocities
    turned = tracked.transformed(inverse(prediction.world_from_ego.matrix @ prediction.ego_from_bev)).velocities
    columns["velocities"] = np.where(own.any(1, keepdims=True), own, turned)
    prediction = replace(prediction, boxes=replace(prediction.boxes, **columns))
    vars(prediction)["boxes_world"] = tracked  # the cached property: boxes are turned once a frame
    return state, prediction


def step(
    config: TrackerConfig, state: TrackerState | None, boxes: Boxes3D, stamp: FrameStamp
) -> tuple[TrackerState, Boxes3D]:
    """The state after a frame, and its boxes with their identities.

    The boxes have the same order and the columns `instances` ("" for a box without a track), `track_scores` (the mean
    score of the track's boxes, NaN without a track) and `duplicates`. A velocity of 0, as of boxes of single images,
    becomes that of the steps of its track, unless it is slow. Boxes that no camera sees (`unseen`) come after the
    others, start no track, and continue one that was in view within the last `carry_s`. Tracks start anew with a new
    scene, and where the time does not advance or advances by more than `coast_s` after the last box.

    Args:
        config: the parameters.
        state: of the frame before, None for the first frame.
        boxes: N predictions in the world frame (or any other one that does not move), with scores.
        stamp: scene and time of the frame.
    """
    scores = np.zeros(len(boxes)) if boxes.scores is None else boxes.scores
    number = 0 if state is None else state.next_number
    tracks = Tracks.empty()
    if state is not None and state.stamp.scene == stamp.scene and stamp.timestamp_ns > state.stamp.timestamp_ns:
        tracks = state.tracks[stamp.timestamp_ns - state.tracks.seen_ns <= config.coast_s * 1e9]
    unseen = np.zeros(len(boxes), dtype=bool) if boxes.unseen is None else boxes.unseen
    order = np.lexsort((-scores, unseen))
    duplicates = find_duplicates(boxes, order, config.duplicate_widths)
    usable = order[~duplicates[order] & (scores[order] >= config.keep_score)]
    matches = _match(config, tracks, boxes, usable, unseen, stamp)
    born = usable[(matches[usable] < 0) & (scores[usable] >= config.birth_score) & ~unseen[usable]]
    matches[born] = len(tracks) + np.arange(len(born))
    nothing, nowhere = np.zeros(len(born), dtype=np.int64), np.zeros((len(born), 2))
    numbers, no_scores = number + np.arange(len(born)), np.zeros(len(born))
    new = Tracks(numbers, boxes.classes[born], nowhere, nowhere, nothing, nothing, nothing, no_scores)
    tracks = Tracks(*(np.concatenate([getattr(tracks, c.name), getattr(new, c.name)]) for c in fields(Tracks)))
    owned = np.flatnonzero(matches >= 0)
    owners = matches[owned]
    velocities = boxes.velocities.copy()
    tracks.velocities[owners], velocities[owned] = _velocities(tracks[owners], boxes[owned], stamp)
    tracks.centers_xy[owners] = boxes.centers[owned, :2]
    tracks.seen_ns[owners] = stamp.timestamp_ns
    tracks.in_view_ns[owners[~unseen[owned]]] = stamp.timestamp_ns
    tracks.frames[owners] += 1
    tracks.score_sums[owners] += scores[owned]
    instances = np.full(len(boxes), "", dtype="<U20")
    instances[owned] = tracks.numbers[owners].astype("<U20")
    track_scores = np.full(len(boxes), np.nan)
    track_scores[owned] = tracks.score_sums[owners] / tracks.frames[owners]
    columns = {"instances": instances, "track_scores": track_scores, "duplicates": duplicates}
    tracked = replace(boxes, velocities=velocities, **columns)
    lost = tracks.seen_ns != stamp.timestamp_ns
    tracks = tracks[~(lost & (tracks.frames < config.confirm_frames))]
    return TrackerState(tracks, stamp, number + len(born)), tracked


def without_identities(boxes: Boxes3D) -> Boxes3D:
    """The boxes without the columns that tracking adds."""
    return replace(boxes, instances=None, track_scores=None, duplicates=None)


def find_duplicates(boxes: Boxes3D, order: NDArray[np.int64], widths: float) -> NDArray[np.bool_]:
    """Mask (N,) of the boxes on an object that a better box of their class describes already.

    order: (N,) their indices, the best first. widths: distance of the centres, in widths of the better box.
    """
    ranked = boxes[order]
    x, y = ranked.centers[:, :2].T
    near = np.hypot(x[:, None] - x, y[:, None] - y) < widths * ranked.sizes_lwh[:, 1, None]
    _, classes = np.unique(ranked.classes, return_inverse=True)
    near &= classes[:, None] == classes
    near = np.triu(near, k=1)  # (N, N): row i says which worse boxes lie on the object of box i
    worse = np.zeros(len(boxes), dtype=bool)
    for rank, row in enumerate(near):
        if not worse[rank]:
            worse |= row
    duplicates = np.zeros(len(boxes), dtype=bool)
    duplicates[order] = worse
    return duplicates


def _match(
    config: TrackerConfig,
    tracks: Tracks,
    boxes: Boxes3D,
    usable: NDArray[np.int64],
    unseen: NDArray[np.bool_],
    stamp: FrameStamp,
) -> NDArray[np.int64]:
    """(N,) the index of each box's track, -1 for none. `usable` (M,): the boxes that may match, best first."""
    matches = np.full(len(boxes), -1)
    if not len(tracks):
        return matches
    places = tracks.centers_xy
    if config.use_velocity:
        seconds = (stamp.timestamp_ns - tracks.seen_ns) / 1e9
        places = places + np.nan_to_num(tracks.velocities) * seconds[:, None]
    away = np.linalg.norm(boxes.centers[usable, None, :2] - places, axis=-1)  # (M, T)
    away[boxes.classes[usable, None] != tracks.classes] = np.inf
    away[unseen[usable, None] & (stamp.timestamp_ns - tracks.in_view_ns > config.carry_s * 1e9)] = np.inf
    other = config.gates_m.get(OTHER, ObjectClass.gate_m)
    gates = [config.gates_m.get(name, other) for name in boxes.classes[usable].tolist()]
    wider = np.where(tracks.velocities.any(1) | (not config.use_velocity), 1.0, FIRST_GATE)
    away[away > np.array(gates, dtype=np.float64)[:, None] * wider] = np.inf
    for box, distances in zip(usable, away, strict=True):
        nearest = int(np.argmin(distances))
        if np.isfinite(distances[nearest]):
            matches[box] = nearest
            away[:, nearest] = np.inf
    return matches


def _velocities(tracks: Tracks, boxes: Boxes3D, stamp: FrameStamp) -> tuple[Array, Array]:
    """Those of N tracks after a frame, and of their boxes, (N, 2) each, see `step`."""
    seconds = np.maximum(stamp.timestamp_ns - tracks.seen_ns, 1)[:, None] / 1e9
    steps = (boxes.centers[:, :2] - tracks.centers_xy) / seconds
    frames = np.maximum(tracks.frames, 1)[:, None]
    share = np.maximum(1 / (frames + 1), LEAST_SHARE)
    is_stated = ((tracks.frames == 0) | boxes.velocities.any(1))[:, None]
    of_tracks = np.where(is_stated, boxes.velocities, tracks.velocities + share * (steps - tracks.velocities))
    is_slow = ~is_stated & (np.linalg.norm(of_tracks, axis=1, keepdims=True) < SLOW_MPS * (1 + 1 / frames))
    return of_tracks, np.where(is_slow, 0.0, of_tracks)
