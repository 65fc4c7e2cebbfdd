"""Track queries (MOTR, Zeng et al. 2022; UniAD, Hu et al. 2023): decoder queries that follow one object over frames.

Each has a memory of its own embeddings, and all attend to each other before the next frame.
"""

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import ObjectQueries, inverse_sigmoid
from bevcli.model.upload import exchanged, tensors_in

NO_TRACK, EGO = -1, -2  # ids of queries that belong to no track, and of the ego query


@dataclass(frozen=True)
class TrackQueryConfig:
    """The life of tracks, and the modules that update their queries."""

    # a query without a track starts one with this score or more; a track's misses are forgotten
    birth_score: float = 0.4
    keep_score: float = 0.35  # below this score a track has a miss, and is not given out
    max_misses: int = 5  # the track ends with this miss
    memory_length: int = 4  # number of embeddings that a track remembers
    memory_interval: int = 4  # a track saves its embedding at its first frame and then at every such frame
    attention_heads: int = 8  # of the memory's attention and of the query interaction
    # boxes whose centre has a larger |x|, |y| or |z| are left out, bev frame
    center_range_m: tuple[float, float, float] = (61.2, 61.2, 10.0)
    # height that the box codes state, "center" of the box or its "bottom", as in the released code
    box_z: Literal["center", "bottom"] = "bottom"

    def __post_init__(self) -> None:
        if not 0 <= self.keep_score <= self.birth_score <= 1:
            raise ValueError("keep_score and birth_score must be 0 to 1, keep_score not above birth_score")
        counts = (self.max_misses, self.memory_length, self.memory_interval, self.attention_heads)
        if min(counts) < 1 or min(self.center_range_m) <= 0:
            raise ValueError("max_misses, memory_length, memory_interval, heads and center_range_m must be positive")


@dataclass(frozen=True)
class Memories:
    """The memories of K tracks."""

    embeddings: Tensor  # (K, M, C), the newest last
    is_empty: Tensor  # (K, M) bool, slots without an embedding
    wait: Tensor  # (K,) int64 number of frames until the next embedding is saved; 0 saves in this frame

    def __getitem__(self, selection: Tensor) -> "Memories":
        """The memories of a mask (K,) bool."""
        return Memories(*(column[selection] for column in vars(self).values()))

    @staticmethod
    def empty(like: Tensor, length: int) -> "Memories":
        """The memories of K new tracks. like: (K, C), embeddings of the tracks. length: M."""
        count, channels = like.shape
        return Memories(
            like.new_zeros(count, length, channels),
            torch.ones(count, length, dtype=torch.bool, device=like.device),
            torch.zeros(count, dtype=torch.int64, device=like.device),
        )

    def followed_by(self, others: "Memories") -> "Memories":
        """These memories, then the others."""
        columns = zip(vars(self).values(), vars(others).values(), strict=True)
        return Memories(*map(torch.cat, columns))


@dataclass(frozen=True)
class TrackQueries:
    """The K tracks of one sequence between two frames."""

    position: Tensor  # (K, C) first half of the queries
    content: Tensor  # (K, C) second half of the queries
    box_codes: Tensor  # (K, 10) boxes of the last frame, in its bev frame; see `bevcli.model.decoder`
    ids: Tensor  # (K,) int64 identities
    misses: Tensor  # (K,) int64 number of misses since the score was last high
    memories: Memories  # of the K tracks
    next_id: int  # identity of the next track. It never falls, so that identities differ between scenes, too

    def __len__(self) -> int:
        return len(self.ids)

    def ended(self) -> "TrackQueries":
        """No track; the identities go on where they are."""
        queries: TrackQueries = exchanged(self, (column[:0] for _, column in tensors_in(self)))
        return queries

    def to(self, device: torch.device) -> "TrackQueries":
        """The same tracks on a device."""
        queries: TrackQueries = exchanged(self, (column.to(device) for _, column in tensors_in(self)))
        return queries


@dataclass(frozen=True)
class FrameMotion:
    """The motion since the previous frame."""

    bev_from_previous_bev: Tensor  # (4, 4) float32, from the previous frame's bev metres to this frame's
    seconds: float  # between the two frames


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
    return ObjectQueries(*(torch.cat([new, old[None]], dim=1) for new, old in zip(fresh, kept, strict=True)))


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


class MemoryBank(nn.Module):
    """Attention of tracks to their memories, and the saving of new ones, after MOTR.

    One track with 3 memories and an interval of 2 frames; sK is what was saved of its embedding in frame K:

        frame           0        1        2        3        4        5        6
        memories     [- - -]  [- - s0] [- - s0] [- s0 s2] [- s0 s2] [s0 s2 s4] ...   the newest last, - for none
        attends to      -       s0       s0      s0, s2   s0, s2   s0, s2, s4
        wait            0        1        0        1        0        1        0
        saves then     s0        -       s2        -       s4        -       s6
    """

    def __init__(self, channels: int, heads: int, interval: int) -> None:
        super().__init__()
        self.interval = interval
        self.attention = nn.MultiheadAttention(channels, heads, batch_first=True)
        self.expand = nn.Linear(channels, channels)
        self.reduce = nn.Linear(channels, channels)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.save_projection = nn.Linear(channels, channels)

    def forward(self, embedding: Tensor, memories: Memories) -> tuple[Tensor, Memories]:
        """embedding: (K, C) of the decoder -> the embedding (K, C) after the attention, and the memories after it."""
        remembers = ~memories.is_empty[:, -1]
        if remembers.any():
            query, known = embedding[remembers], memories[remembers]
            slots, is_empty = known.embeddings, known.is_empty
            attended, _ = self.attention(query[:, None], slots, slots, key_padding_mask=is_empty, need_weights=False)
            query = self.norms[0](query + attended[:, 0])
            query = self.norms[1](query + self.reduce(F.relu(self.expand(query))))
            embedding = embedding.masked_scatter(remembers[:, None], query)
        saves = memories.wait == 0
        newest = self.save_projection(embedding)[:, None]
        shifted = torch.cat([memories.embeddings[:, 1:], newest], dim=1)
        shifted_empty = torch.cat([memories.is_empty[:, 1:], torch.zeros_like(memories.is_empty[:, :1])], dim=1)
        return embedding, Memories(
            torch.where(saves[:, None, None], shifted, memories.embeddings),
            torch.where(saves[:, None], shifted_empty, memories.is_empty),
            torch.where(saves, self.interval - 1, memories.wait - 1),
        )


class QueryInteraction(nn.Module):
    """Self-attention among the tracks; position and content of their queries take up the result."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.self_attention = nn.MultiheadAttention(channels, heads, batch_first=True)
        self.feed_forward = ResidualBlock(channels)
        self.norm = nn.LayerNorm(channels)
        self.position = ResidualBlock(channels)
        self.content = ResidualBlock(channels)

    def forward(self, embedding: Tensor, position: Tensor, content: Tensor) -> tuple[Tensor, Tensor]:
        """Position (K, C) and content (K, C) of the queries for the next frame.

        Args:
            embedding: (K, C) of the tracks, after the memory bank; K is at least 1.
            position: (K, C) first half of their queries in this frame.
            content: (K, C) second half.
        """
        key = (embedding + position)[None]
        attended, _ = self.self_attention(key, key, embedding[None], need_weights=False)
        embedding = self.norm(embedding + attended[0])
        embedding = self.feed_forward(embedding, embedding)
        return self.position(position, embedding), self.content(content, embedding)


class ResidualBlock(nn.Module):
    """A query plus a two-layer network of an embedding, normalised."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.expand = nn.Linear(channels, channels)
        self.reduce = nn.Linear(channels, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, query: Tensor, embedding: Tensor) -> Tensor:
        """query, embedding: (K, C) -> (K, C)."""
        return self.norm(query + self.reduce(F.relu(self.expand(embedding))))
