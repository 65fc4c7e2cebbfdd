"""Track queries (MOTR, Zeng et al. 2022; UniAD, Hu et al. 2023): decoder queries that follow one object over frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import ObjectQueries, inverse_sigmoid
from bevcli.workshop.uniad.memory_bank import Memories

NO_TRACK, EGO = -1, -2  # ids of queries that belong to no track, and of the ego query


@dataclass(frozen=True)
class TrackQueryConfig:
    """The life of tracks, and the modules that update their queries.

    Attributes:
        birth_score: a query without a track starts one with this score or more; a track's misses are forgotten.
        keep_score: below this score a track has a miss, and is not given out.
        max_misses: the track ends with this miss.
        memory_length: number of embeddings that a track remembers.
        memory_interval: a track saves its embedding at its first frame and then at every such frame.
        attention_heads: of the memory's attention and of the query interaction.
        center_range_m: boxes whose centre has a larger |x|, |y| or |z| are left out, bev frame.
        box_z: height that the box codes state, "center" of the box or its "bottom", as in the released code.
    """

    birth_score: float = 0.4
    keep_score: float = 0.35
    max_misses: int = 5
    memory_length: int = 4
    memory_interval: int = 4
    attention_heads: int = 8
    center_range_m: tuple[float, float, float] = (61.2, 61.2, 10.0)
    box_z: Literal["center", "bottom"] = "bottom"

    def __post_init__(self) -> None:
        if not 0 <= self.keep_score <= self.birth_score <= 1:
            raise ValueError("keep_score and birth_score must be 0 to 1, keep_score not above birth_score")
        counts = (self.max_misses, self.memory_length, self.memory_interval, self.attention_heads)
        if min(counts) < 1 or min(self.center_range_m) <= 0:
            raise ValueError("max_misses, memory_length, memory_interval, heads and center_range_m must be positive")


@dataclass(frozen=True)
class TrackQueries:
    """The K tracks of one sequence between two frames.

    Attributes:
        position: (K, C) first half of the queries.
        content: (K, C) second half of the queries.
        box_codes: (K, 10) boxes of the last frame, in its bev frame; see `bevcli.model.box_coding`.
        ids: (K,) int64 identities.
        misses: (K,) int64 number of misses since the score was last high.
        memories: of the K tracks.
        next_id: identity of the next track. It never falls, so that identities differ between scenes, too.
    """

    position: Tensor
    content: Tensor
    box_codes: Tensor
    ids: Tensor
    misses: Tensor
    memories: Memories
    next_id: int

    def __len__(self) -> int:
        return len(self.ids)

    def ended(self) -> TrackQueries:
        """No track; the identities go on where they are."""
        return self._each(lambda column: column[:0])

    def to(self, device: torch.device) -> TrackQueries:
        """The same tracks on a device."""
        return self._each(lambda column: column.to(device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> TrackQueries:
        queries = change(self.position), change(self.content), change(self.box_codes)
        return TrackQueries(*queries, change(self.ids), change(self.misses), self.memories.each(change), self.next_id)


@dataclass(frozen=True)
class FrameMotion:
    """The motion since the previous frame.

    Attributes:
        bev_from_previous_bev: (4, 4) float32, from the previous frame's bev metres to this frame's.
        seconds: between the two frames.
    """

    bev_from_previous_bev: Tensor
    seconds: float


def with_tracks(
    learned: ObjectQueries, tracks: TrackQueries, motion: FrameMotion, heights: Tensor, grid: BevGrid
) -> ObjectQueries:
    """The learned queries, then those of the tracks where their objects are expected: (1, Q + K, …).

    Args:
        learned: (1, Q, …), the same in every frame.
        motion: since the frame of the tracks.
        heights: (K,) z of the reference points of the tracks, 0 to 1 over the range.
        grid: gives the range of the reference points.
    """
    centers = expected_centers(tracks.box_codes, motion)
    ranges = torch.tensor([grid.x_range_m, grid.y_range_m], device=centers.device)
    places = (centers[:, :2] - ranges[:, 0]) / (ranges[:, 1] - ranges[:, 0])
    places = inverse_sigmoid(places).sigmoid()  # inside the range, as the decoder's reference points always are
    reference_points = torch.cat([places, heights[:, None]], dim=-1)
    kept = (tracks.position, tracks.content, reference_points)
    fresh = (learned.position, learned.content, learned.reference_points)
    return ObjectQueries(*(torch.cat([one, other[None]], dim=1) for one, other in zip(fresh, kept, strict=True)))


def expected_centers(box_codes: Tensor, motion: FrameMotion) -> Tensor:
    """(K, 3) metres, bev frame: boxes (K, 10) of the previous frame, moved with their velocity, seen from now."""
    velocities = torch.cat([box_codes[:, 8:10], torch.zeros_like(box_codes[:, :1])], dim=-1)
    moved = box_codes[:, [0, 1, 4]] + velocities * motion.seconds  # centres
    matrix = motion.bev_from_previous_bev
    return moved @ matrix[:3, :3].T + matrix[:3, 3]


def live_and_die(
    ids: Tensor, misses: Tensor, scores: Tensor, next_id: int, config: TrackQueryConfig
) -> tuple[Tensor, Tensor, int]:
    """Identities (N,) and misses (N,) after births and deaths in a frame, and the identity of the next track.

    Args:
        ids: (N,) int64, identities before: of tracks 0 or larger, else NO_TRACK or EGO.
        misses: (N,) int64.
        scores: (N,) the highest class score of each query.
        next_id: identity of the next track.
        config: the thresholds.
    """
    misses = misses.masked_fill(scores >= config.birth_score, 0)
    missed = (ids >= 0) & (scores < config.keep_score)
    misses = misses + missed
    born = (ids == NO_TRACK) & (scores >= config.birth_score)
    ids = torch.where(born, next_id - 1 + born.cumsum(0), ids)
    ids = ids.masked_fill(missed & (misses >= config.max_misses), NO_TRACK)
    return ids, misses, next_id + int(born.sum())
