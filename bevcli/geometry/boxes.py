"""Oriented 3D boxes in one frame of reference, with class, score, velocity and further optional columns.

`match_greedily` is the rule of the nuScenes devkit for boxes of two sources.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from math import nan
from typing import Annotated, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.errors import BevcliError
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array, apply

IMPOSSIBLE = "left out: a size of 0 or less, or not finite"  # boxes that `Boxes3D.possible` leaves out
MATCH_DISTANCE_M = 2.0  # between centres on the ground: for errors, recall, tracks, and what is shown as found


@dataclass(frozen=True)
class Column:
    """An optional column of boxes with one value a box. Files, tables, scores and recordings take it from here."""

    key: str  # its name in JSON, CSV and tables
    # "score": 0 to 1, of all boxes or of none; "share": 0 to 1, or NaN; "text"; "flag": true or false; "count": an
    # integer, 0 or more
    values: Literal["score", "share", "text", "flag", "count"]
    recorded: str = ""  # its name in recordings; "" where they do not have it

    @property
    def unknown(self) -> Any:
        """The value of a box where it is unknown."""
        return {"score": nan, "share": nan, "text": "", "flag": False, "count": -1}[self.values]


@dataclass(frozen=True)
class Box3D:
    """One of `Boxes3D`, in the same frame of reference.

    Attributes:
        class_name: such as "car".
        score: confidence, 0 to 1; None if it is unknown.
        center: (3,) metres.
        size_lwh: (3,) length, width and height, metres.
        yaw: radians, counter-clockwise about z, 0 along x.
        velocity: (2,) m/s along x and y; NaN if unknown.
        columns: the further columns that the boxes have, by key: "attribute", "instance" and so on.
    """

    class_name: str
    score: float | None
    center: Array
    size_lwh: Array
    yaw: float
    velocity: Array
    columns: Mapping[str, Any]

    def __repr__(self) -> str:
        score = "" if self.score is None else f" {self.score:.2f}"
        x, y, z = self.center
        return f"Box3D({self.class_name}{score} at {x:.1f}, {y:.1f}, {z:.1f} m, yaw {np.degrees(self.yaw):.0f}°)"


# What selects several boxes: a mask (N,) bool, an index array or a slice.
Selection = slice | Sequence[int] | Sequence[bool] | NDArray[Any] | np.bool


@dataclass(frozen=True)
class Boxes3D:
    """N boxes in one frame of reference: bev, ego or world. The owner of the object states which one.

    They are a sequence of `Box3D`. An optional column is None if it is unknown for all boxes.

    Attributes:
        centers: (N, 3) box centres, metres.
        sizes_lwh: (N, 3) length, width and height, metres.
        yaws: (N,) radians, counter-clockwise about z, 0 along x.
        velocities: (N, 2) m/s along x and y; NaN if unknown.
        classes: (N,) class names.
        scores: (N,) confidence, 0 to 1. Optional.
        attributes: (N,) nuScenes attribute names, "" for none. Optional.
        instances: (N,) object identities, constant over time, "" for none. Optional.
        track_scores: (N,) score of the track that a box belongs to, 0 to 1; NaN without a track. Optional.
        duplicates: (N,) whether a better box describes the same object. Optional.
        visibilities: (N,) visible fraction, 0 to 1; NaN if unknown. Optional.
        num_points: (N,) number of lidar and radar points; boxes with 0 are not scored, -1 if unknown. Optional.
        unseen: (N,) whether no camera with an image sees the place. Optional.
        futures: (N, M, T, 3) M possible futures in T steps: seconds from the boxes' time, then x and y of the centre,
            metres; NaN if unknown. Optional.
        future_scores: (N, M) score of each future, 0 to 1. Optional.
    """

    centers: Array
    sizes_lwh: Array
    yaws: Array
    velocities: Array
    classes: NDArray[np.str_]
    scores: Annotated[Array | None, Column("score", "score", recorded="score")] = None
    attributes: Annotated[NDArray[np.str_] | None, Column("attribute", "text")] = None
    instances: Annotated[NDArray[np.str_] | None, Column("instance", "text", recorded="track")] = None
    track_scores: Annotated[Array | None, Column("track_score", "share")] = None
    duplicates: Annotated[NDArray[np.bool_] | None, Column("duplicate", "flag")] = None
    visibilities: Annotated[Array | None, Column("visibility", "share")] = None
    num_points: Annotated[NDArray[np.int64] | None, Column("num_points", "count")] = None
    unseen: Annotated[NDArray[np.bool_] | None, Column("unseen", "flag")] = None
    futures: Array | None = None
    future_scores: Array | None = None

    def __len__(self) -> int:
        return len(self.centers)

    @overload
    def __getitem__(self, selection: int | np.integer[Any]) -> Box3D: ...

    @overload
    def __getitem__(self, selection: Selection) -> "Boxes3D": ...

    def __getitem__(self, selection: int | np.integer[Any] | Selection) -> "Box3D | Boxes3D":
        """The box at an index, or the boxes of a mask (N,) bool, an index array or a slice."""
        if isinstance(selection, int | np.integer):
            return self._box(int(selection))
        key = selection if isinstance(selection, slice) else np.asarray(selection)
        columns: dict[str, Any] = {name: None if c is None else c[key] for name, c in vars(self).items()}
        return Boxes3D(**columns)

    def __iter__(self) -> Iterator[Box3D]:
        return map(self._box, range(len(self)))

    def __repr__(self) -> str:
        names, counts = np.unique(self.classes, return_counts=True)
        listed = ", ".join(f"{count} {names[i]}" for i, count in sorted(enumerate(counts), key=lambda pair: -pair[1]))
        return f"Boxes3D({len(self)} boxes{': ' if listed else ''}{listed})"

    def _box(self, index: int) -> Box3D:
        columns = {column.key: getattr(self, name) for name, column in OPTIONAL_COLUMNS.items()}
        row = {key: values[index].item() for key, values in columns.items() if values is not None}
        center, size, yaw, velocity = (c[index] for c in (self.centers, self.sizes_lwh, self.yaws, self.velocities))
        return Box3D(str(self.classes[index]), row.pop("score", None), center, size, float(yaw), velocity, row)

    def scored(self, least: float) -> "Boxes3D":
        """The boxes with a score of at least `least`; all boxes where they have no scores."""
        return self if self.scores is None else self[self.scores >= least]

    def shown(self, least: float) -> "Boxes3D":
        """As `scored`, without the boxes that no camera sees, but for those of a track: history carries these."""
        boxes = self.scored(least)
        if boxes.unseen is None:
            return boxes
        return boxes[~boxes.unseen if boxes.instances is None else ~boxes.unseen | (boxes.instances != "")]

    def possible(self) -> "Boxes3D":
        """The boxes with sizes above 0 and finite numbers; velocities may be unknown."""
        kept = (self.sizes_lwh > 0).all(axis=1) & np.isfinite(self.to_numpy()[:, :7]).all(axis=1)
        return self if kept.all() else self[kept]

    @staticmethod
    def empty() -> "Boxes3D":
        """Zero boxes."""
        return Boxes3D(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)), np.zeros(0, "<U1"))

    @staticmethod
    def concatenate(parts: Iterable["Boxes3D"]) -> "Boxes3D":
        """All boxes of the parts. An optional column is kept if every part with boxes has it."""
        filled = [boxes for boxes in parts if len(boxes)]
        if not filled:
            return Boxes3D.empty()
        columns: dict[str, Any] = {}
        for field in fields(Boxes3D):
            values = [getattr(boxes, field.name) for boxes in filled]
            columns[field.name] = None if any(v is None for v in values) else np.concatenate(values)
        return Boxes3D(**columns)

    def transformed(self, a_from_b: ArrayLike) -> "Boxes3D":
        """The boxes moved from frame b to frame a. Yaws and velocities rotate too; boxes stay upright.

        a_from_b: (4, 4) rigid transform, metres.
        """
        matrix = np.asarray(a_from_b, dtype=np.float64)
        headings = np.stack([np.cos(self.yaws), np.sin(self.yaws), np.zeros(len(self))], axis=-1)
        turned = headings @ matrix[:3, :3].T
        velocities = np.concatenate([self.velocities, np.zeros((len(self), 1))], axis=-1) @ matrix[:3, :3].T
        return replace(
            self,
            centers=apply(matrix, self.centers),
            yaws=np.arctan2(turned[:, 1], turned[:, 0]),
            velocities=velocities[:, :2],
            futures=None if self.futures is None else self._moved_futures(matrix, self.futures),
        )

    def _moved_futures(self, matrix: Array, futures: Array) -> Array:
        """Futures (N, M, T, 3) in another frame. An object keeps its height."""
        heights = np.broadcast_to(self.centers[:, None, None, 2:], (*futures.shape[:3], 1))
        moved = apply(matrix, np.concatenate([futures[..., 1:], heights], axis=-1))
        return np.concatenate([futures[..., :1], moved[..., :2]], axis=-1)

    def corners(self) -> Array:
        """(N, 8, 3) corners, metres: bottom four counter-clockwise from front left, then the top four likewise."""
        half = self.sizes_lwh[:, None, :] / 2
        signs = [[x, y, z] for z in (-1, 1) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        local = half * np.array(signs)
        c, s = np.cos(self.yaws)[:, None], np.sin(self.yaws)[:, None]
        x = c * local[..., 0] - s * local[..., 1]
        y = s * local[..., 0] + c * local[..., 1]
        return np.stack([x, y, local[..., 2]], axis=-1) + self.centers[:, None, :]

    def to_numpy(self) -> Array:
        """(N, 9) float64: x, y, z of the centre, length, width, height, yaw, velocity x and y; metres, radians, m/s."""
        return np.concatenate([self.centers, self.sizes_lwh, self.yaws[:, None], self.velocities], axis=1)

    def to_dict(self) -> dict[str, list[Any]]:
        """The boxes as a table: column name -> N values. `pandas.DataFrame` and `polars.DataFrame` take it.

        The columns are TABLE_COLUMNS, without the optional ones that are None. Futures are left out.
        """
        values = {"class": self.classes, **dict(zip(NUMBERS, self.to_numpy().T, strict=True))}
        values |= {column.key: getattr(self, name) for name, column in OPTIONAL_COLUMNS.items()}
        return {key: values[key].tolist() for key in TABLE_COLUMNS if values[key] is not None}

    def to_pandas(self) -> Any:
        """The table of `to_dict` as a `pandas.DataFrame`. Raises BevcliError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise BevcliError("pandas is not installed: run pip install pandas, or use `to_dict()`") from None
        return pandas.DataFrame(self.to_dict())


OPTIONAL_COLUMNS: dict[str, Column] = {
    field.name: column for field in fields(Boxes3D) for column in getattr(field.type, "__metadata__", ())
}
NUMBERS = ("x", "y", "z", "length", "width", "height", "yaw", "vx", "vy")  # of `Boxes3D.to_numpy`
_KEYS = [column.key for column in OPTIONAL_COLUMNS.values()]
TABLE_COLUMNS = ("class", _KEYS[0], *NUMBERS, *_KEYS[1:])  # class, score, x, …, vy, attribute, …

# The twelve edges of `Boxes3D.corners`, as pairs of corner indices.
BOX_EDGES = (
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip

MOVING_MPS = 0.2  # a faster box counts as moving


def attributes_by_speed(boxes: Boxes3D, classes: Mapping[str, ObjectClass] = NUSCENES_CLASSES) -> NDArray[np.str_]:
    """(N,) nuScenes attribute names from class and speed, as the original BEVFormer assigns them.

    Classes without attributes get "". A box with unknown velocity counts as standing.
    """
    moving = np.linalg.norm(boxes.velocities, axis=1) > MOVING_MPS
    choices = [classes[name].attributes if name in classes else ("", "") for name in boxes.classes.tolist()]
    return np.array([pair[0 if fast else 1] for pair, fast in zip(choices, moving, strict=True)], dtype=np.str_)


@dataclass(frozen=True)
class Box2D:
    """One of `Boxes2D`.

    Attributes:
        class_name: such as "person".
        score: confidence, 0 to 1.
        corners: (4,) x0, y0, x1, y1, pixels.
    """

    class_name: str
    score: float
    corners: Array

    def __repr__(self) -> str:
        x0, y0, x1, y1 = self.corners
        return f"Box2D({self.class_name} {self.score:.2f} at {x0:.0f}, {y0:.0f}, {x1:.0f}, {y1:.0f})"


@dataclass(frozen=True)
class Boxes2D:
    """N boxes in an image, by falling score. They are a sequence of `Box2D`.

    Attributes:
        corners: (N, 4) x0, y0, x1, y1, pixels of the camera's image, whose first pixel has its centre at (0, 0): a box
            of the whole image is (-0.5, -0.5, width - 0.5, height - 0.5).
        classes: (N,) names of COCO: person, bicycle, car, motorcycle, bus, truck, traffic light.
        scores: (N,) confidence, 0 to 1.
    """

    corners: Array
    classes: NDArray[np.str_]
    scores: Array

    def __len__(self) -> int:
        return len(self.scores)

    def __iter__(self) -> Iterator[Box2D]:
        for class_name, score, corners in zip(self.classes, self.scores, self.corners, strict=True):
            yield Box2D(str(class_name), float(score), corners)

    def scored(self, least: float) -> "Boxes2D":
        """Those with this score or more."""
        chosen = self.scores >= least
        return Boxes2D(self.corners[chosen], self.classes[chosen], self.scores[chosen])

    def outlines(self) -> Array:
        """(N, 5, 2) pixels, closed."""
        return self.corners[:, [[0, 1], [2, 1], [2, 3], [0, 3], [0, 1]]]


@dataclass(frozen=True)
class ScoredBoxes:
    """N boxes of many frames."""

    boxes: Boxes3D  # with all optional columns
    frames: NDArray[np.int64]  # (N,), index of each box's frame
    ranges_m: Array  # (N,), distance from the ego vehicle on the ground, metres

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, selection: NDArray[Any]) -> "ScoredBoxes":
        """The boxes selected by a mask (N,) bool or by indices."""
        return ScoredBoxes(*(column[selection] for column in vars(self).values()))

    def column(self, name: str) -> NDArray[Any]:
        """An optional column of the boxes."""
        values: NDArray[Any] | None = getattr(self.boxes, name)
        assert values is not None
        return values


def descending_scores(scores: Array) -> NDArray[np.int64]:
    """(P,), indices that sort by descending score; of equal scores the later one is first, as in the devkit."""
    return np.argsort(scores, kind="stable")[::-1]


def match_greedily(
    ground_truth: ScoredBoxes, predictions: ScoredBoxes, distances_m: tuple[float, ...]
) -> NDArray[np.int64]:
    """Match boxes of one class by the distance of their centres on the ground.

    ground_truth: G boxes. predictions: P boxes in the order of `descending_scores`. distances_m: D matching distances,
    each matched independently.

    Each prediction in turn takes the nearest free ground truth of its frame, if that is closer than the matching
    distance. Returns (D, P) indices into `ground_truth`, -1 without a match.

    All frames are processed together: first the best prediction of every frame, then the second best, and so on.
    """
    matched = np.full((len(distances_m), len(predictions)), -1)
    if not len(ground_truth) or not len(predictions):
        return matched
    frame_count = int(max(ground_truth.frames.max(), predictions.frames.max())) + 1
    truths_of = _indices_by_frame(ground_truth.frames, frame_count)  # (F, K)
    predictions_of = _indices_by_frame(predictions.frames, frame_count)  # (F, R), best first
    centers = ground_truth.boxes.centers[:, :2]
    free = np.broadcast_to(truths_of >= 0, (len(distances_m), *truths_of.shape)).copy()  # (D, F, K)
    for turn in range(predictions_of.shape[1]):
        frames = np.flatnonzero((predictions_of[:, turn] >= 0) & (truths_of[:, 0] >= 0))  # (A,)
        turn_rows = predictions_of[frames, turn]
        offsets = centers[truths_of[frames]] - predictions.boxes.centers[turn_rows, None, :2]
        distance = np.hypot(offsets[..., 0], offsets[..., 1])  # (A, K)
        for row, limit in enumerate(distances_m):
            candidates = np.where(free[row, frames], distance, np.inf)
            nearest = candidates.argmin(axis=1)
            is_match = candidates[np.arange(len(frames)), nearest] < limit
            free[row, frames[is_match], nearest[is_match]] = False
            matched[row, turn_rows[is_match]] = truths_of[frames[is_match], nearest[is_match]]
    return matched


def _indices_by_frame(frames: NDArray[np.int64], frame_count: int) -> NDArray[np.int64]:
    """(F, K), the indices of each frame's boxes in their order, padded with -1."""
    counts = np.bincount(frames, minlength=frame_count)
    order = np.argsort(frames, kind="stable")
    starts = np.cumsum(counts) - counts
    table = np.full((frame_count, int(counts.max())), -1)
    table[frames[order], np.arange(len(frames)) - starts[frames[order]]] = order
    return table
