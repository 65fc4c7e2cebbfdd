"""BEVFormerV2 (Yang et al. 2022): the BEV maps of a window of frames, each from its own images, fused into one.

There is no recurrence: every frame of the window is encoded in the current frame's BEV grid, without history. For
inference, temporal self-attentions without a history are exchanged for ones that compute beforehand what is constant.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor, nn

from bevcli.errors import BevcliError, ConfigError
from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Pose
from bevcli.model.bev_queries import BevQueries
from bevcli.model.bevformer_v2.bev_fusion import BevFusion, BevFusionConfig
from bevcli.model.bevformer_v2.window import FeatureWindow, FrameFeatures, WindowFrame, fill_window, frames_at, kept
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_attention import DeformableAttention, FeatureMaps
from bevcli.model.ego_motion import EgoMotionConfig
from bevcli.model.encoder import Encoder, EncoderLayer, TemporalSelfAttention
from bevcli.model.network import STAGES, Network
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.step import ClipInputs, ModelOutputs, PreparedFrame
from bevcli.model.upload import upload
from bevcli.workshop.engines.window_export import WindowForm

NO_EGO_MOTION = EgoMotionConfig(can_bus=False, shift=False, rotation=False)

# Parts of the released files that only training uses: a head on the image features, and further groups of queries.
PERSPECTIVE_HEAD = "fcos3d_bbox_head."
OBJECT_QUERIES = "pts_bbox_head.query_embedding.weight"
OFFICIAL_QUERIES = 900  # in a group


@dataclass(frozen=True, kw_only=True)
class BEVFormerV2Config(ModelConfig):
    """A whole BEVFormerV2. The neck may have more levels than there are level embeddings: those are for training only.

    Attributes:
        frames: the frames of the window, relative to the current one, in the order of fusion: [-1, 0] is the previous
            frame and the current one. Positive numbers are later frames (offline use).
        fusion: fuses the BEV maps of the window; unused where the window has only one frame.
        ego_motion: switched off; the poses enter by the projections of the window's frames.
    """

    architecture: ClassVar[str] = "BEVFormerV2"
    trains_with_gaps: ClassVar[bool] = False

    frames: tuple[int, ...]
    fusion: BevFusionConfig = field(default_factory=BevFusionConfig)
    ego_motion: EgoMotionConfig = NO_EGO_MOTION

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 not in self.frames or list(self.frames) != sorted(set(self.frames)):
            raise ValueError("frames must be ascending, and hold 0, the current frame")
        if self.ego_motion.can_bus or self.ego_motion.shift or self.ego_motion.rotation:
            raise ValueError("ego_motion: can_bus, shift and rotation must be false: BEVFormerV2 has no recurrence")

    @property
    def past_frames(self) -> int:
        return -self.frames[0]

    @property
    def later_frames(self) -> int:
        return self.frames[-1]

    @property
    def uses_history(self) -> bool:
        return len(self.frames) > 1

    def check_training(self, clip_frames: int) -> None:
        if self.later_frames:
            raise ConfigError(
                f"{self.name}: frames after the current one cannot be trained; expected frames that end with 0, "
                f"found {list(self.frames)}"
            )
        if clip_frames <= self.past_frames:
            raise ConfigError(
                f"{self.name}: training.clips.frames must be at least {self.past_frames + 1}, so that a clip fills the "
                f"window of the model, but is {clip_frames}"
            )

    def _most_neck_levels(self) -> int:
        return self.neck.levels


class BEVFormerV2(Network):
    """The whole model: a window of frames."""

    config: BEVFormerV2Config
    config_class = BEVFormerV2Config
    memory_type = FeatureWindow
    device_parts = ("image_features", "device_part")
    stages: Mapping[str, str] = STAGES | {"fusion": "fusion"}
    official_names = (
        (r"^pts_bbox_head\.transformer\.fusion\.layers\.", "fusion.blocks."),
        (r"^pts_bbox_head\.transformer\.fusion\.layer_norm\.0\.", "fusion.projection."),
        (r"^pts_bbox_head\.transformer\.fusion\.layer_norm\.1\.", "fusion.norm."),
    )

    def __init__(self, config: BEVFormerV2Config) -> None:
        super().__init__(config)
        grid, count = config.bev_grid, len(config.frames)
        self.fusion: BevFusion | None = None
        if count > 1:
            self.fusion = BevFusion(config.fusion, count, config.channels, (grid.rows, grid.columns))

    def forward(self, window: Sequence[WindowFrame | None]) -> ModelOutputs:
        """One step. window: the frames in the order of `config.frames`.

        A frame that does not exist, such as before the scene's first, is None. Its BEV map is that of the nearest frame
        towards the current one.
        """
        found: ModelOutputs = self.device_part(*self.host_part(window))
        return found

    def host_part(
        self, window: Sequence[WindowFrame | None]
    ) -> tuple[tuple[tuple[FeatureMaps, PillarHits], ...], tuple[int, ...]]:
        """The image features and hits of the frames that exist, and for each of the window the index of its frame."""
        sources = fill_window(self.config.frames, [frame is not None for frame in window])
        current = self.config.frames.index(0)
        # The current frame is the last, so that observers of the encoder see it.
        places = [*(place for place in sorted(set(sources)) if place != current), current]
        frames = [frame for frame in (window[place] for place in places) if frame is not None]
        hits = [self.pillars(frame.image_from_bev, frame.image_size, frame.has_image) for frame in frames]
        seen = tuple((frame.image_features, found) for frame, found in zip(frames, hits, strict=True))
        return seen, tuple(places.index(place) for place in sources)

    def device_part(self, frames: Sequence[tuple[FeatureMaps, PillarHits]], sources: Sequence[int]) -> ModelOutputs:
        """The outputs of a step: a function of tensors without a wait for the device. Arguments: see `host_part`."""
        # One frame after the other: as a batch they would need the memory of all at once and, on a CPU, as much time.
        maps = [self.encode(*frame) for frame in frames]
        return self.detect(maps[-1] if self.fusion is None else self.fusion([maps[place] for place in sources]))

    def encode(self, image_features: FeatureMaps, hits: PillarHits) -> Tensor:
        """The BEV map (B, Y·X, C) of one frame's images, in the current frame's BEV grid."""
        batch = len(hits.cameras_per_cell) // len(self.bev_queries.embedding)
        bev: Tensor = self.encoder(
            bev_query=self.bev_queries.embedding.expand(batch, -1, -1),
            position=self.bev_queries.position(),
            image_features=image_features,
            hits=hits,
        )
        return bev

    def step(
        self, prepared: PreparedFrame, memory: FeatureWindow | None, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[ModelOutputs, FeatureWindow]:
        """See `TemporalModel`; the images of a frame pass the backbone once."""
        memory = FeatureWindow(()) if memory is None else memory
        past = memory.before(prepared.frame.stamp, self.config.past_frames)
        known = {frame.stamp: frame for frame in memory.frames}
        present = [known.get(one.frame.stamp) or self._features(one) for one in (prepared, *upcoming)]
        frames, current = (*past, *present), len(past)
        outputs = self(frames_at(frames, [current + offset for offset in self.config.frames], prepared))
        return outputs, kept(frames, current, self.config.past_frames)

    def _features(self, prepared: PreparedFrame) -> FrameFeatures:
        images, camera_index = (upload(x, self.device) for x in (prepared.images, prepared.camera_index))
        return FrameFeatures.of(prepared, self.image_features(images, camera_index))

    def exchange_parts(self) -> None:
        """See `TemporalModel`: no ego-motion enters the BEV queries, and they take the place of the history."""
        first, *others = self.encoder.layers
        first.temporal_self_attention = ConstantTemporalSelfAttention(self.encoder, self.bev_queries)
        for layer in others:
            assert isinstance(layer, EncoderLayer)
            own = OwnQueriesAttention(layer.temporal_self_attention, self.bev_queries.position())
            layer.set_submodule("temporal_self_attention", own)
        super().exchange_parts()

    def remember(self, clip: ClipInputs, place: int, memory: list[FeatureMaps] | None) -> list[FeatureMaps]:
        """See `Network`; the memory of a clip are the image features of all its frames so far."""
        inputs = clip.inputs[place]
        return [*(memory or ()), self.image_features(inputs.images, inputs.camera_index)]

    def learn(
        self, clip: ClipInputs, place: int, memory: list[FeatureMaps] | None
    ) -> tuple[ModelOutputs, list[FeatureMaps]]:
        """See `Network`; the BEV encoder and the fusion are trained on the whole window."""
        features = self.remember(clip, place, memory)
        places = [place + offset for offset in self.config.frames]
        outputs = self([_clip_frame(clip, features[at], at, place) if at >= 0 else None for at in places])
        return outputs, [FeatureMaps(frame.tokens.detach(), frame.level_shapes) for frame in features]

    def run_on_shapes(self, images: Tensor, camera_index: Tensor, hits: PillarHits) -> Tensor:
        """See `Network`. Every frame of the window is encoded anew; its images were seen before."""
        features = self.image_features(images, camera_index)
        query, position = self.bev_queries(torch.empty(1, 18)), self.bev_queries.position()
        maps = [self.encoder(query, position, features, hits) for _ in self.config.frames]
        bev: Tensor = maps[0] if self.fusion is None else self.fusion(maps)
        self.decoder(bev, self.detection_head)
        return bev

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> WindowForm:
        assert isinstance(config, BEVFormerV2Config)
        if config.later_frames:
            raise BevcliError(
                f"{config.name}: a model that looks at later frames cannot be exported: frames is "
                f"{list(config.frames)} (expected a window that ends with 0, the current frame)"
            )
        return WindowForm(config, cameras, config.frames)

    @classmethod
    def with_past(cls, memory: FeatureWindow, past: Sequence[tuple[FrameStamp, Pose]]) -> FeatureWindow:
        """See `TemporalModel`: the earlier frames have copies of the image features."""
        if not memory.frames:
            return memory  # nothing of one frame is kept for the next
        seen = memory.frames[-1]
        return FeatureWindow((*(replace(seen, stamp=stamp, pose=pose) for stamp, pose in past), seen))

    @classmethod
    def without_training_parts(cls, state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
        head = [key for key in state if key.startswith(PERSPECTIVE_HEAD)]
        left = {key: tensor for key, tensor in state.items() if key not in head}
        parts = [f"{len(head)} keys {PERSPECTIVE_HEAD}*"] if head else []
        queries = state.get(OBJECT_QUERIES)
        if queries is not None and queries.ndim == 2:
            groups, rest = divmod(len(queries), OFFICIAL_QUERIES)
            if groups > 1 and not rest:
                left[OBJECT_QUERIES] = queries[:OFFICIAL_QUERIES].clone()
                parts.append(f"{groups - 1} of {groups} groups of object queries")
        return left, " and ".join(parts)

    @classmethod
    def part_names(cls, config: ModelConfig) -> Iterator[tuple[str, ...]]:
        """See `TemporalModel`; the fusion comes between the encoder and the object queries."""
        assert isinstance(config, BEVFormerV2Config)
        for name, *modules in super().part_names(config):
            if name.startswith("object queries (position"):
                for block in range(config.fusion.blocks):
                    yield f"fusion of the window: residual block {block}", f"fusion.blocks.{block}"
                yield "fusion of the window: projection and norm", "fusion.projection", "fusion.norm"
            yield name, *modules


def _clip_frame(clip: ClipInputs, features: FeatureMaps, place: int, current: int) -> WindowFrame:
    """The frames at a place of the clips, seen from the bev frames of the current ones."""
    inputs = clip.inputs[place]
    image_from_bev = inputs.image_from_bev
    if place != current:
        moved = torch.linalg.solve(clip.world_from_bev[place], clip.world_from_bev[current])
        image_from_bev = (image_from_bev.double() @ moved[:, None]).float()
    return WindowFrame(features, image_from_bev, inputs.has_image, inputs.image_size)


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
        sums = (self.both(query) + self.constant).split(self.sizes, dim=-1)
        return self.plain.sample(bev_maps, reference_points, *self.plain.attention.as_samples(*sums))
