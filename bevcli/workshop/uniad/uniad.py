"""UniAD's first stage (Hu et al. 2023): BEVFormer's BEV map, track queries that follow objects, and a panoptic map."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, NoReturn

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.checkpoints import OfficialNames, Renames
from bevcli.errors import BevcliError, ConfigError
from bevcli.frame import BevMap, FrameResult
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, Pose, inverse
from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import ObjectQueries, boxes_of_codes, inverse_sigmoid
from bevcli.model.ego_motion import EgoMotionConfig
from bevcli.model.network import STAGES
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.step import ModelInputs, ModelOutputs, PreparedFrame, model_inputs
from bevcli.model.upload import exchanged, tensors_in, upload, without_autocast
from bevcli.parsing.documents import Count, Positive, Share
from bevcli.workshop.uniad.map_head import MapHead, MapHeadConfig, MapOutputs, merge_map

NO_TRACK, EGO = -1, -2  # ids of queries that belong to no track, and of the ego query


@dataclass(frozen=True)
class TrackQueryConfig:
    """The life of tracks, and the modules that update their queries."""

    birth_score: Share = 0.4  # a query with it or more starts a track; a track's misses are forgotten
    keep_score: Share = 0.35  # below this score a track has a miss, and is not given out
    max_misses: Count = 5  # the track ends with this miss
    memory_length: Count = 4  # number of embeddings that a track remembers
    memory_interval: Count = 4  # a track saves its embedding at its first frame and then at every such frame
    attention_heads: Count = 8  # of the memory's attention and of the query interaction
    center_range_m: tuple[Positive, Positive, Positive] = (61.2, 61.2, 10.0)  # of boxes, |x|, |y|, |z|, bev frame
    box_z: Literal["center", "bottom"] = "bottom"  # height that the box codes state; "bottom" in the released code

    def __post_init__(self) -> None:
        if self.keep_score > self.birth_score:
            raise ValueError("keep_score must not be above birth_score")


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


@dataclass(frozen=True, kw_only=True)
class UniADConfig(ModelConfig):
    """A whole UniAD, first stage. The last one of decoder.queries is the ego query: it describes the own vehicle."""

    architecture: ClassVar[str] = "UniAD"
    has_tracks: ClassVar[bool] = True

    ego_motion: EgoMotionConfig = field(default_factory=lambda: EgoMotionConfig(first_frame="original"))
    track_queries: TrackQueryConfig = field(default_factory=TrackQueryConfig)  # life of tracks
    map_head: MapHeadConfig = field(default_factory=MapHeadConfig)  # the map head

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.heads != ("detection",):
            raise ValueError('heads must be ["detection"]: UniAD has a map head of its own')
        if self.decoder.queries < 2 or self.decoder.training_groups != 1:
            raise ValueError("decoder.queries must be at least 2, one object and the ego query; training_groups 1")
        if self.channels % self.track_queries.attention_heads or self.channels % self.map_head.attention_heads:
            raise ValueError(f"channels is {self.channels}; it must be a multiple of the attention_heads")

    @property
    def map_classes(self) -> tuple[str, ...]:
        return self.map_head.classes

    def check_training(self, clip_frames: int) -> None:
        raise ConfigError(f"{self.name}: a UniAD cannot be trained; expected a BEVFormer, such as tiny, small or base")


@dataclass(frozen=True, kw_only=True)
class UniADOutputs(ModelOutputs):
    """The outputs of one step for the N queries of the frame: the learned ones, then those of the tracks."""

    stay_on_device: ClassVar[tuple[str, ...]] = ("bev", "tracks", "map")

    ids: Tensor  # (N,) int64 identities after births and deaths; NO_TRACK and EGO for queries without one
    scores: Tensor  # (N,) the highest class score of each query
    tracks: TrackQueries  # what the next frame needs
    map: MapOutputs | None = None  # of the map head; None where it was not asked for


@dataclass(frozen=True)
class TrackMemory:
    """The memory of a UniAD."""

    bev: Tensor | None  # (1, Y·X, C), the BEV map of the last frame; None where a scene has ended
    tracks: TrackQueries  # of the last frame, with their memories
    pose: Pose  # world_from_ego of that frame
    ego_from_bev: Array  # (4, 4) of that frame
    timestamp_ns: int  # of that frame


# Keys without effect at inference.
_UNUSED = (
    r"^(pts_bbox_head\.(past_traj_reg_branches|query_embedding|transformer\.reference_points)\.|criterion\.|bbox_size_fc\."
    r"|seg_head\.(bev_embedding|reg_branches2|cls_thing_branches|cls_stuff_branches|cls_branches\.[0-4])\."
    r"|seg_head\.(things|stuff)_mask_head\.blocks\.\d+\.attn\.linear)"
)

_RENAMES: Renames = (
    (r"^query_embedding\.weight$", "decoder.query_embedding"),
    (r"^reference_points\.", "decoder.reference_points."),
    (r"^memory_bank\.temporal_attn\.", "memory_bank.attention."),
    (r"^memory_bank\.temporal_fc1\.", "memory_bank.expand."),
    (r"^memory_bank\.temporal_fc2\.", "memory_bank.reduce."),
    (r"^memory_bank\.temporal_norm(\d)\.", lambda m: f"memory_bank.norms.{int(m[1]) - 1}."),
    (r"^memory_bank\.save_proj\.", "memory_bank.save_projection."),
    (r"^query_interact\.self_attn\.", "query_interaction.self_attention."),
    (r"^query_interact\.linear1\.", "query_interaction.feed_forward.expand."),
    (r"^query_interact\.linear2\.", "query_interaction.feed_forward.reduce."),
    (r"^query_interact\.norm1\.", "query_interaction.norm."),
    (r"^query_interact\.norm2\.", "query_interaction.feed_forward.norm."),
    (r"^query_interact\.linear_pos1\.", "query_interaction.position.expand."),
    (r"^query_interact\.linear_pos2\.", "query_interaction.position.reduce."),
    (r"^query_interact\.norm_pos\.", "query_interaction.position.norm."),
    (r"^query_interact\.linear_feat1\.", "query_interaction.content.expand."),
    (r"^query_interact\.linear_feat2\.", "query_interaction.content.reduce."),
    (r"^query_interact\.norm_feat\.", "query_interaction.content.norm."),
    (r"^seg_head\.transformer\.level_embeds$", "map_head.encoder.level_embedding"),
    (r"^seg_head\.transformer\.encoder\.", "map_head.encoder."),
    (r"^seg_head\.transformer\.decoder\.", "map_head.location_decoder."),
    (r"^seg_head\.transformer\.reference_points\.", "map_head.location_decoder.reference_points."),
    (r"^seg_head\.query_embedding\.weight$", "map_head.location_decoder.query_embedding"),
    (r"^seg_head\.reg_branches\.", "map_head.location_decoder.location_branches."),
    (r"^seg_head\.cls_branches\.5\.", "map_head.class_branch."),
    (r"^seg_head\.stuff_query\.weight$", "map_head.stuff_queries"),
    (r"^seg_head\.things_mask_head\.", "map_head.thing_masks."),
    (r"^seg_head\.stuff_mask_head\.", "map_head.stuff_masks."),
    (r"^(map_head\.encoder\..*)\.attentions\.0\.", r"\1.self_attention."),
    (r"^(map_head\.\w+_masks)\.blocks\.", r"\1.layers."),
    (r"^(map_head\.\w+_masks)\.attnen\.linear_l1\.0\.", r"\1.masks.hidden."),
    (r"^(map_head\.\w+_masks)\.attnen\.linear\.0\.", r"\1.masks.output."),
    (r"^(map_head\.\w+_masks)\.attnen\.", r"\1.masks."),
    (r"^(map_head\.\w+_masks\..*)\.head_norm1\.", r"\1.norms.0."),
    (r"^(map_head\.\w+_masks\..*)\.head_norm2\.", r"\1.norms.1."),
    (r"^(map_head\.\w+_masks\..*)\.norm3\.", r"\1.self_attention_norm."),
    (r"^(map_head\.\w+_masks\..*)\.self_attention\.qkv\.", r"\1.self_attention.in_proj_"),
    (r"^(map_head\.\w+_masks\..*)\.self_attention\.proj\.", r"\1.self_attention.out_proj."),
    (r"^(map_head\.\w+_masks\..*)\.attn\.proj\.", r"\1.output_projection."),
    (r"^(map_head\.\w+_masks\..*)\.attn\.", r"\1."),
    (r"^(map_head\.\w+_masks\..*)\.mlp\.fc1\.", r"\1.feed_forward.expand."),
    (r"^(map_head\.\w+_masks\..*)\.mlp\.fc2\.", r"\1.feed_forward.reduce."),
    (r"^(map_head\.\w+_masks\..*)\.q\.", r"\1.query_projection."),
    (r"^(map_head\.\w+_masks\..*)\.k\.", r"\1.key_projection."),
    (r"^(map_head\.\w+_masks\..*)\.v\.", r"\1.value_projection."),
)

# The file of the first stage has its own object queries at the top level, beside those of BEVFormer.
OFFICIAL_NAMES = OfficialNames(r"^(query_embedding|memory_bank|query_interact|seg_head)\.", _RENAMES, _UNUSED)

PART_NAMES = (
    ("tracks: memory bank", "memory_bank"),
    ("tracks: query interaction", "query_interaction"),
    ("map head: encoder", "map_head.encoder"),
    ("map head: location decoder", "map_head.location_decoder"),
    ("map head: class branch", "map_head.class_branch"),
    ("map head: stuff queries", "map_head.stuff_queries"),
    ("map head: mask decoder of things", "map_head.thing_masks"),
    ("map head: mask decoder of stuff", "map_head.stuff_masks"),
)


class UniAD(BEVFormer):
    """The whole model: a recurrence, in which the BEV map and the tracks of a frame go on to the next.

    Identities stay different over all scenes of a run.
    """

    config: UniADConfig
    config_class = UniADConfig
    memory_type = TrackMemory
    waits_within_step = True  # the CPU chooses the tracks
    stages: Mapping[str, str] = STAGES | {"query_interaction": "tracks", "map_head": "map_head"}
    official_names = OFFICIAL_NAMES

    def __init__(self, config: UniADConfig) -> None:
        super().__init__(config)
        tracks = config.track_queries
        self.memory_bank = MemoryBank(config.channels, tracks.attention_heads, tracks.memory_interval)
        self.query_interaction = QueryInteraction(config.channels, tracks.attention_heads)
        self.map_head = MapHead(config.map_head, config.channels, config.bev_grid)

    def forward(
        self,
        inputs: ModelInputs,
        history: Tensor | None = None,
        tracks: TrackQueries | None = None,
        motion: FrameMotion | None = None,
    ) -> UniADOutputs:
        """One step of one sequence.

        Args:
            inputs: a batch of 1.
            history: (1, Y·X, C), the BEV map of the previous frame, or None for a scene's first frame.
            tracks: of the previous frame; None for the first frame of all.
            motion: since the previous frame; needed with tracks.
        """
        bev = self.compute(self.geometry(inputs, history)[0], False)  # the CPU chooses the tracks
        outputs = self.track(bev, tracks, motion)
        with without_autocast(bev.device):
            return replace(outputs, map=self.map_head(bev.float()))

    def track(self, bev: Tensor, tracks: TrackQueries | None, motion: FrameMotion | None) -> UniADOutputs:
        """The tracks and objects in the BEV map (1, Y·X, C): `forward` after the encoder, without the map."""
        # In float32, as the decoder of BEVFormer.
        with without_autocast(bev.device):
            queries = self.decoder.object_queries(batch=1)  # the learned ones, then those of the tracks
            if tracks is not None and len(tracks):
                assert motion is not None
                heights = self.decoder.reference_points(tracks.position)[:, 2].sigmoid()
                queries = with_tracks(queries, tracks, motion, heights, self.config.bev_grid)
            class_logits, box_codes, embedding = self.decoder(bev.float(), self.detection_head, queries)
            scores = class_logits[-1, 0].sigmoid().amax(-1)
            ids, kept = self._tracks(queries, embedding[0], box_codes[-1, 0], scores, tracks)
        return UniADOutputs(bev, class_logits, box_codes, ids=ids, scores=scores, tracks=kept)

    def _tracks(
        self, queries: ObjectQueries, embedding: Tensor, codes: Tensor, scores: Tensor, before: TrackQueries | None
    ) -> tuple[Tensor, TrackQueries]:
        """The identities of N queries, and the tracks for the next frame.

        Args:
            queries: (1, N, …) as they entered the decoder.
            embedding: (N, C) after its last layer.
            codes: (N, 10) box codes of its last layer.
            scores: (N,).
            before: the tracks whose queries are the last ones.
        """
        config, learned = self.config.track_queries, self.config.decoder.queries
        ids = torch.full((learned,), NO_TRACK, device=scores.device)
        ids[-1] = EGO
        misses, next_id = torch.zeros_like(ids), 0
        memories = Memories.empty(embedding[:learned], config.memory_length)
        if before is not None:
            ids, misses = torch.cat([ids, before.ids]), torch.cat([misses, before.misses])
            columns = zip(vars(memories).values(), vars(before.memories).values(), strict=True)
            memories, next_id = Memories(*map(torch.cat, columns)), before.next_id
        ids, misses, next_id = live_and_die(ids, misses, scores, next_id, config)
        alive = ids >= 0
        embedding, position, content = embedding[alive], queries.position[0, alive], queries.content[0, alive]
        memories = memories[alive]
        if alive.any():
            embedding, memories = self.memory_bank(embedding, memories)
            position, content = self.query_interaction(embedding, position, content)
        return ids, TrackQueries(position, content, codes[alive], ids[alive], misses[alive], memories, next_id)

    def step(  # type: ignore[override]  # with a memory of its own
        self, prepared: PreparedFrame, memory: TrackMemory | None, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[UniADOutputs, TrackMemory]:
        frame, device = prepared.frame, self.device
        is_known = memory is not None and (memory.bev is not None or self.config.ego_motion.first_frame == "original")
        previous_pose = memory.pose if memory is not None and is_known else None
        inputs = model_inputs(prepared, previous_pose, self.config)
        inputs = replace(inputs, images=upload(inputs.images, device))
        history = tracks = motion = None
        if memory is not None:
            history = None if memory.bev is None else memory.bev.to(device)
            tracks, motion = memory.tracks.to(device), _motion(prepared, memory, device)
        outputs: UniADOutputs = self(inputs, history, tracks, motion)
        rig, stamp = frame.rig, frame.stamp
        after = TrackMemory(outputs.bev, outputs.tracks, frame.world_from_ego, rig.ego_from_bev, stamp.timestamp_ns)
        return outputs, after

    def restarted(self, memory: TrackMemory) -> TrackMemory:
        """See `TemporalModel`: the next identity, and the pose for EgoMotionConfig.first_frame "original"."""
        return replace(memory, bev=None, tracks=memory.tracks.ended())

    def with_pose(self, memory: TrackMemory, pose: Pose) -> TrackMemory:  # type: ignore[override]
        """See `TemporalModel`."""
        return replace(memory, pose=pose)

    def fix_constant_parts(self) -> None:
        """Nothing is constant, because the tracks and the learned queries attend to each other."""

    def part_names(self) -> Iterator[tuple[str, ...]]:
        """See `TemporalModel`."""
        yield from super().part_names()
        yield from PART_NAMES

    def run_shapes(self, images: Tensor, camera_index: Tensor, hits: PillarHits) -> None:
        """See `Network`."""
        super().run_shapes(images, camera_index, hits)
        grid = self.config.bev_grid
        self.map_head(torch.empty(1, grid.rows * grid.columns, self.config.channels))

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> NoReturn:
        """Raises BevcliError."""
        raise BevcliError(
            f"{config.name}: a UniAD cannot be exported: the number of its tracks changes from frame to frame "
            "(expected a BEVFormer or a BEVFormerV2, such as tiny, base, demo or v2-t2)"
        )

    def decode(self, outputs: ModelOutputs) -> Iterator[Boxes3D | BevMap | FrameResult]:
        assert isinstance(outputs, UniADOutputs)
        grid, head = self.config.bev_grid, self.config.map_head
        yield decode_tracks(outputs, self.config)
        if outputs.map is not None:
            yield merge_map(outputs.map, head, grid).bev_map(grid, head)


def _motion(prepared: PreparedFrame, memory: TrackMemory, device: torch.device) -> FrameMotion:
    frame = prepared.frame
    world_from_bev = frame.world_from_ego.matrix @ frame.rig.ego_from_bev
    bev_from_previous_bev = inverse(world_from_bev) @ memory.pose.matrix @ memory.ego_from_bev
    seconds = (frame.stamp.timestamp_ns - memory.timestamp_ns) / 1e9
    return FrameMotion(torch.from_numpy(bev_from_previous_bev).float().to(device), seconds)


def decode_tracks(outputs: UniADOutputs, config: UniADConfig) -> Boxes3D:
    """The boxes with the best scores, by falling score, bev frame: one for each query, of its best class.

    Boxes of tracks whose score is high enough have an identity in `instances` and their own score in `track_scores`.
    As in the released code, the other queries give boxes too: those that do not start a track, tracks with a miss,
    and the ego query. Boxes outside track_queries.center_range_m are left out, and so are all but
    config.decoder.max_boxes.
    """
    tracks = config.track_queries
    scores, best = outputs.scores.topk(min(config.decoder.max_boxes, len(outputs.scores)))
    labels = outputs.class_logits[-1, 0, best].argmax(-1)
    all_codes = outputs.box_codes[-1, 0, best].double()
    inside = (all_codes[:, [0, 1, 4]].abs() <= torch.tensor(tracks.center_range_m, device=scores.device)).all(-1)
    has_track = (outputs.ids[best] >= 0) & (scores >= tracks.keep_score)
    columns = (all_codes, scores.double(), labels, outputs.ids[best], has_track)
    codes, box_scores, classes, ids, followed = (column[inside].cpu().numpy() for column in columns)
    boxes = boxes_of_codes(codes, np.asarray(config.classes)[classes], box_scores)
    centers = boxes.centers
    if tracks.box_z == "bottom":
        centers = centers + boxes.sizes_lwh * (0, 0, 0.5)
    return replace(
        boxes,
        centers=centers,
        instances=np.where(followed, ids.astype("<U20"), ""),
        track_scores=np.where(followed, box_scores, np.nan),
        duplicates=np.zeros(len(boxes), dtype=bool),
    )
