r"""BEVFormerV2 (Yang et al. 2022): the BEV maps of a window of frames, each from its own images, fused into one.

There is no recurrence: every frame of the window is encoded in the current frame's BEV grid, without history. Its image
features are kept for the next steps.

A window [-2, -1, 0] at frame 1, the second of its scene; frame -1 does not exist:

    images           (none)     frame 0      frame 1        each passes the backbone once
    image features   (none)     kept         new            `FeatureWindow` keeps frame 0 and 1 for frame 2
                                  |            |            `seen_from`: frame 0's cameras in frame 1's bev frame
    BEV encoder                   |            |            the same weights, grid of frame 1, no history
    BEV map          frame 0's  frame 0's    frame 1's      `fill_window`: that of the nearest frame towards 0
                        \_________|____________/
                               BevFusion                    -> the BEV map of frame 1
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Pose
from bevcli.model.backbone import Stage
from bevcli.model.bev_queries import BevQueries
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_attention import DeformableAttention, FeatureMaps
from bevcli.model.encoder import Encoder, EncoderLayer, TemporalSelfAttention
from bevcli.model.network import STAGES, Network
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.resnet import BasicBlock
from bevcli.model.step import Clip, ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import OfficialNames
from bevcli.model.upload import on_device, upload
from bevcli.workshop.bevformer_v2.window import (
    BEVFormerV2Config,
    BevFusionConfig,
    ClipMemory,
    FeatureWindow,
    FrameFeatures,
    WindowForm,
    WindowFrame,
    fill_window,
    frames_at,
    kept,
    seen_in_clip,
)


class BEVFormerV2(Network):
    """The whole model: a window of frames."""

    config: BEVFormerV2Config
    config_class = BEVFormerV2Config
    memory_type = FeatureWindow
    stages: Mapping[str, str] = STAGES | {"fusion": "fusion"}
    official_names = OfficialNames(
        mark=r"^(fcos3d_bbox_head|pts_bbox_head\.transformer\.fusion)\.",
        renames=(
            (r"^pts_bbox_head\.transformer\.fusion\.layers\.", "fusion.blocks."),
            (r"^pts_bbox_head\.transformer\.fusion\.layer_norm\.0\.", "fusion.projection."),
            (r"^pts_bbox_head\.transformer\.fusion\.layer_norm\.1\.", "fusion.norm."),
        ),
        unused=r"^fcos3d_bbox_head\.",  # a head on the image features, for training only
        unused_text="{count} keys fcos3d_bbox_head.*",
    )

    def __init__(self, config: BEVFormerV2Config) -> None:
        super().__init__(config)
        grid, count = config.bev_grid, len(config.frames)
        self.fusion: BevFusion | None = None
        if count > 1:
            self.fusion = BevFusion(config.fusion, count, config.channels, (grid.rows, grid.columns))

    def step(
        self, prepared: PreparedFrame, memory: FeatureWindow | None, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[ModelOutputs, FeatureWindow]:
        """See `TemporalModel`; the images of a frame pass the backbone once."""
        memory = FeatureWindow(()) if memory is None else memory
        past = memory.before(prepared.frame.stamp, self.config.past_frames)
        features = {frame.stamp: frame for frame in memory.frames}
        present = [features.get(now.frame.stamp) or self._features(now) for now in (prepared, *upcoming)]
        frames, current = (*past, *present), len(past)
        outputs = self(frames_at(frames, [current + offset for offset in self.config.frames], prepared))
        return outputs, kept(frames, current, self.config.past_frames)

    def _features(self, prepared: PreparedFrame) -> FrameFeatures:
        images, camera_index = (upload(x, self.device) for x in (prepared.images, prepared.camera_index))
        return FrameFeatures.of(prepared, self.image_features(images, camera_index))

    @on_device
    def image_features(self, images: Tensor, camera_index: Tensor) -> FeatureMaps:
        """See `Network`."""
        return super().image_features(images, camera_index)

    def with_pose(self, memory: FeatureWindow, pose: Pose) -> FeatureWindow:
        """See `TemporalModel`."""
        if not memory.frames:
            return memory  # a window of one frame
        return FeatureWindow((*memory.frames[:-1], replace(memory.frames[-1], pose=pose)))

    def with_past(self, memory: FeatureWindow, past: Sequence[tuple[FrameStamp, Pose]]) -> FeatureWindow:
        """See `TemporalModel`: copies of the image features."""
        if not memory.frames:
            return memory
        seen = memory.frames[-1]
        return FeatureWindow((*(replace(seen, stamp=stamp, pose=pose) for stamp, pose in past), seen))

    def fix_constant_parts(self) -> None:
        """See `TemporalModel`: temporal self-attentions and the decoder's first self-attention."""
        first, *others = self.encoder.layers
        first.temporal_self_attention = ConstantTemporalSelfAttention(self.encoder, self.bev_queries)
        for layer in others:
            assert isinstance(layer, EncoderLayer)
            attention = OwnQueriesAttention(layer.temporal_self_attention, self.bev_queries.position())
            layer.set_submodule("temporal_self_attention", attention)
        self.decoder.fix_first_attention()

    def bev_part_names(self) -> Iterator[tuple[str, ...]]:
        """See `Network`."""
        yield from super().bev_part_names()
        for block in range(len(self.fusion.blocks) if self.fusion is not None else 0):
            yield f"fusion of the window: residual block {block}", f"fusion.blocks.{block}"
        yield "fusion of the window: projection and norm", "fusion.projection", "fusion.norm"

    def history_of_clip(self, clip: Clip, frame: int, memory: ClipMemory | None) -> ClipMemory:
        """See `Network`; BEV encoder and fusion are trained on the whole window."""
        inputs = clip.inputs[frame]
        return [*(memory or ()), self.image_features(inputs.images, inputs.camera_index)]

    def outputs_of_clip(self, clip: Clip, frame: int, memory: ClipMemory | None) -> tuple[ModelOutputs, ClipMemory]:
        """See `Network`."""
        features = self.history_of_clip(clip, frame, memory)
        indices = [frame + offset for offset in self.config.frames]
        window = [seen_in_clip(frame, clip, features[index], index) if index >= 0 else None for index in indices]
        return self(window), [FeatureMaps(maps.tokens.detach(), maps.level_shapes) for maps in features]

    def run_shapes(self, images: Tensor, camera_index: Tensor, hits: PillarHits) -> None:
        """See `Network`. Every frame of the window is encoded anew; its images were seen before."""
        features, frames = self.image_features(images, camera_index), len(self.config.frames)
        self.compute(((features, hits),) * frames, range(frames))

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> Any:
        """See `TemporalModel`."""
        assert isinstance(config, BEVFormerV2Config)
        return WindowForm(config, cameras)

    def forward(self, window: Sequence[WindowFrame | None]) -> ModelOutputs:
        """One step. window: the frames in the order of `config.frames`.

        A frame that does not exist, such as before the scene's first, is None. Its BEV map is that of the nearest frame
        towards the current one.
        """
        outputs: ModelOutputs = self.compute(*self.geometry(window))
        return outputs

    def geometry(
        self, window: Sequence[WindowFrame | None]
    ) -> tuple[tuple[tuple[FeatureMaps, PillarHits], ...], tuple[int, ...]]:
        """The image features and hits of the frames that exist, and for each of the window the index of its frame."""
        sources = fill_window(self.config.frames, [frame is not None for frame in window])
        current = self.config.frames.index(0)
        # The current frame is the last, so that observers of the encoder see it.
        indices = [*(index for index in sorted(set(sources)) if index != current), current]
        frames = [frame for frame in (window[index] for index in indices) if frame is not None]
        hits = [self.pillars(frame.image_from_bev, frame.image_size, frame.has_image) for frame in frames]
        seen = tuple((frame.image_features, of_frame) for frame, of_frame in zip(frames, hits, strict=True))
        return seen, tuple(indices.index(index) for index in sources)

    @on_device
    def compute(self, frames: Sequence[tuple[FeatureMaps, PillarHits]], sources: Sequence[int]) -> ModelOutputs:
        """The device part of a step. Arguments: see `geometry`."""
        position = self.bev_queries.position()
        maps = []
        # One frame after the other: as a batch they would need the memory of all at once and, on a CPU, as much time.
        for image_features, hits in frames:
            batch = len(hits.cameras_per_cell) // len(position)
            bev_query = self.bev_queries.embedding.expand(batch, -1, -1)
            maps.append(self.encoder(bev_query, position, image_features, hits))
        return self.detect(maps[-1] if self.fusion is None else self.fusion([maps[index] for index in sources]))


class BevFusion(nn.Module):
    """Temporal fusion of the window (section 3.4): maps concatenated, residual blocks, linear layer and layer norm."""

    def __init__(self, config: BevFusionConfig, frames: int, channels: int, bev_shape: tuple[int, int]) -> None:
        """Random weights. frames: number of BEV maps. bev_shape: their rows and columns."""
        super().__init__()
        self.bev_shape = bev_shape
        inputs = [frames * channels] + (config.blocks - 1) * [config.width]
        self.blocks = Stage(*(BasicBlock(size, config.width) for size in inputs))
        self.projection = nn.Linear(config.width, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """maps: (B, Y·X, C) of each frame, in the order of the window -> the fused map (B, Y·X, C)."""
        cells = torch.cat(list(maps), dim=-1).unflatten(1, self.bev_shape)  # (B, Y, X, frames · C)
        fused = self.blocks(cells.permute(0, 3, 1, 2))  # (B, width, Y, X)
        return self.norm(self.projection(fused.permute(0, 2, 3, 1).flatten(1, 2)))


class ConstantTemporalSelfAttention(nn.Module):
    """Takes the place of the first encoder layer's temporal self-attention, whose input is the same in every frame."""

    attended: Tensor

    def __init__(self, encoder: Encoder, bev_queries: BevQueries) -> None:
        super().__init__()
        first = encoder.layers[0].get_submodule("temporal_self_attention")
        assert isinstance(first, TemporalSelfAttention)
        self.attention = first.attention  # for observers of the encoder
        queries = bev_queries.embedding[None]
        with torch.no_grad():
            attended = first(queries, bev_queries.position(), queries[:, None], encoder.reference_points(None))
        self.register_buffer("attended", attended, persistent=False)  # (1, Y·X, C)

    def forward(self, query: Tensor, position: Tensor, bev_maps: Tensor, reference_points: Tensor) -> Tensor:
        """Arguments as for `TemporalSelfAttention`, of which only the shape of the query is read -> (B, Y·X, C)."""
        return self.attended.expand_as(query)


class OwnQueriesAttention(nn.Module):
    """Takes the place of a temporal self-attention that never has a history: both maps are the queries.

    Offsets and weights are a linear function of (query, query + position). The products with the query are added up
    beforehand, and those with the position computed.
    """

    constant: Tensor

    def __init__(self, plain: TemporalSelfAttention, position: Tensor) -> None:
        """position: (Y·X, C), position embedding of the cells."""
        super().__init__()
        self.plain = plain
        layers = (plain.attention.sampling_offsets, plain.attention.attention_weights)
        of_history, of_query = torch.cat([layer.weight for layer in layers]).chunk(2, dim=1)
        bias = torch.cat([layer.bias for layer in layers])
        self.sizes = [layer.out_features for layer in layers]
        self.both = nn.Linear(of_query.shape[1], of_query.shape[0], bias=False, device="meta")
        self.both.weight = nn.Parameter(of_history + of_query, requires_grad=False)
        self.register_buffer("constant", position @ of_query.T + bias, persistent=False)  # (Y·X, both sizes)

    @property
    def attention(self) -> DeformableAttention:
        """The deformable attention, for observers of the encoder."""
        return self.plain.attention

    def forward(self, query: Tensor, position: Tensor, bev_maps: Tensor, reference_points: Tensor) -> Tensor:
        """As `TemporalSelfAttention.forward`; the position is not read."""
        offsets, logits = (self.both(query) + self.constant).split(self.sizes, dim=-1)
        shape = self.plain.attention.shape
        offsets, logits = offsets.float().unflatten(-1, (*shape, 2)), logits.unflatten(-1, shape)
        return self.plain.sample(bev_maps, reference_points, offsets, logits)
