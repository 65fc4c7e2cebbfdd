"""UniAD's first stage (Hu et al. 2023): BEVFormer's BEV map, track queries that follow objects, and a panoptic map."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from bevcli.model.bevformer import BEVFormer, BEVFormerConfig, BEVFormerInputs, BEVFormerOutputs
from bevcli.model.decoder import ObjectQueries
from bevcli.model.ego_motion import EgoMotionConfig
from bevcli.model.map_head import MapHead, MapHeadConfig, MapOutputs
from bevcli.model.memory_bank import Memories, MemoryBank
from bevcli.model.query_interaction import QueryInteraction
from bevcli.model.track_queries import (
    EGO,
    NO_TRACK,
    FrameMotion,
    TrackQueries,
    TrackQueryConfig,
    live_and_die,
    with_tracks,
)


@dataclass(frozen=True, kw_only=True)
class UniADConfig(BEVFormerConfig):
    """A whole UniAD, first stage. The last one of decoder.queries is the ego query: it describes the own vehicle.

    Attributes:
        track_queries: the life of tracks, and the modules that update their queries.
        map_head: the map head.
    """

    ego_motion: EgoMotionConfig = field(default_factory=lambda: EgoMotionConfig(first_frame="original"))
    track_queries: TrackQueryConfig = field(default_factory=TrackQueryConfig)
    map_head: MapHeadConfig = field(default_factory=MapHeadConfig)

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
        """See `BEVFormerConfig.map_classes`."""
        return self.map_head.classes


@dataclass(frozen=True, kw_only=True)
class UniADOutputs(BEVFormerOutputs):
    """What one step computes, for the N queries of the frame: the learned ones, then those of the tracks.

    Attributes:
        ids: (N,) int64 identities after births and deaths; NO_TRACK and EGO for queries without one.
        scores: (N,) the highest class score of each query.
        tracks: what the next frame needs.
        map: of the map head; None where it was not asked for.
    """

    ids: Tensor
    scores: Tensor
    tracks: TrackQueries
    map: MapOutputs | None = None


class UniAD(BEVFormer):
    """The whole model: a recurrence, in which the BEV map and the tracks of a frame go on to the next."""

    config: UniADConfig

    def __init__(self, config: UniADConfig) -> None:
        super().__init__(config)
        tracks = config.track_queries
        self.memory_bank = MemoryBank(config.channels, tracks.attention_heads, tracks.memory_interval)
        self.query_interaction = QueryInteraction(config.channels, tracks.attention_heads)
        self.map_head = MapHead(config.map_head, config.channels, config.bev_grid)

    def forward(
        self,
        inputs: BEVFormerInputs,
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
        bev = self.bev_map(inputs, history)
        outputs = self.track(bev, tracks, motion)
        with torch.autocast(bev.device.type, enabled=False):
            return replace(outputs, map=self.map_head(bev.float()))

    def track(self, bev: Tensor, tracks: TrackQueries | None, motion: FrameMotion | None) -> UniADOutputs:
        """The tracks and objects in the BEV map (1, Y·X, C): `forward` after the encoder, without the map."""
        # In float32, as the decoder of BEVFormer.
        with torch.autocast(bev.device.type, enabled=False):
            queries = self._queries(tracks, motion)
            class_logits, box_codes, embedding = self.decoder(bev.float(), self.detection_head, queries)
            scores = class_logits[-1, 0].sigmoid().amax(-1)
            ids, kept = self._tracks(queries, embedding[0], box_codes[-1, 0], scores, tracks)
        return UniADOutputs(bev, class_logits, box_codes, ids=ids, scores=scores, tracks=kept)

    def _queries(self, tracks: TrackQueries | None, motion: FrameMotion | None) -> ObjectQueries:
        """The queries of a frame: the learned ones, then those of the tracks."""
        learned = self.decoder.object_queries(batch=1)
        if tracks is None or not len(tracks):
            return learned
        assert motion is not None
        heights = self.decoder.reference_points(tracks.position)[:, 2].sigmoid()
        return with_tracks(learned, tracks, motion, heights, self.config.bev_grid)

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
            memories, next_id = memories.followed_by(before.memories), before.next_id
        ids, misses, next_id = live_and_die(ids, misses, scores, next_id, config)
        alive = ids >= 0
        embedding, position, content = embedding[alive], queries.position[0, alive], queries.content[0, alive]
        memories = memories[alive]
        if alive.any():
            embedding, memories = self.memory_bank(embedding, memories)
            position, content = self.query_interaction(embedding, position, content)
        return ids, TrackQueries(position, content, codes[alive], ids[alive], misses[alive], memories, next_id)
