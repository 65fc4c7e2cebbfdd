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
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.errors import BevcliError, ConfigError
from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Array, Pose
from bevcli.model.backbone import Stage
from bevcli.model.bev_queries import BevQueries
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_attention import DeformableAttention, FeatureMaps
from bevcli.model.ego_motion import EgoMotionConfig
from bevcli.model.encoder import Encoder, EncoderLayer, TemporalSelfAttention
from bevcli.model.network import STAGES, Network
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.resnet import BasicBlock
from bevcli.model.step import Clip, ModelOutputs, PreparedFrame, model_inputs
from bevcli.model.temporal_model import OfficialNames
from bevcli.model.upload import on_device, upload
from bevcli.parsing.documents import Count
from bevcli.workshop.engines.export_form import ExportedStep, ExportForm, Port, camera_feed, camera_ports

NO_EGO_MOTION = EgoMotionConfig(can_bus=False, shift=False, rotation=False)
# Metres. Where poses are nearer to the world's origin, float32 holds them to a millimetre. nuScenes' maps reach 3 km.
FLOAT32_RANGE_M = 10_000
ClipMemory = list[FeatureMaps]  # the image features of all frames of training clips so far


@dataclass(frozen=True)
class BevFusionConfig:
    """The fusion of the window's BEV maps."""

    blocks: Count = 3  # number of residual blocks
    width: Count = 512  # channels of the blocks; the first one has a convolution as shortcut where it gets others


@dataclass(frozen=True, kw_only=True)
class BEVFormerV2Config(ModelConfig):
    """A whole BEVFormerV2. Levels of the neck beyond the level embeddings are for training only."""

    architecture: ClassVar[str] = "BEVFormerV2"
    trains_with_gaps: ClassVar[bool] = False
    trains_with_more_levels: ClassVar[bool] = True

    # the frames of the window, relative to the current one, in the order of fusion: [-1, 0] is the previous frame and
    # the current one. Positive numbers are later frames (offline use)
    frames: tuple[int, ...]
    fusion: BevFusionConfig = field(default_factory=BevFusionConfig)  # of the BEV maps of a window of several frames
    ego_motion: EgoMotionConfig = NO_EGO_MOTION  # poses enter by the projections of the window's frames

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 not in self.frames or list(self.frames) != sorted(set(self.frames)):
            raise ValueError("frames must be ascending, and hold 0, the current frame")
        if self.ego_motion.can_bus or self.ego_motion.shift or self.ego_motion.rotation:
            raise ValueError("ego_motion: can_bus, shift and rotation must be false: BEVFormerV2 has no recurrence")
        if self.horizon or self.hybrid_queries.count:
            raise ValueError("horizon and hybrid_queries must be left out: they are parts of a BEVFormer alone")

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


@dataclass(frozen=True)
class WindowFrame:
    """One frame of the window of B sequences with N cameras."""

    image_features: FeatureMaps  # tokens of the B·N images
    image_from_bev: Tensor  # (B, N, 4, 4) float32, from the current frame's bev metres to pixels of this frame's images
    has_image: Tensor  # (B, N) bool; a camera without an image sees no BEV cell
    image_size: tuple[int, int]  # (height, width) of the network's input, pixels


@dataclass(frozen=True)
class FrameFeatures:
    """The image features of one frame and where its cameras were."""

    stamp: FrameStamp  # of the frame
    pose: Pose  # its world_from_ego
    image_features: FeatureMaps  # tokens of its N images
    image_from_bev: Tensor  # (1, N, 4, 4) float64 on the CPU, from the frame's own bev metres to network pixels
    has_image: Tensor  # (1, N) bool

    @staticmethod
    def of(prepared: PreparedFrame, features: FeatureMaps) -> "FrameFeatures":
        """The features of a frame's images."""
        frame, projections = prepared.frame, prepared.image_from_bev
        return FrameFeatures(frame.stamp, frame.world_from_ego, features, projections, prepared.has_image)

    def seen_from(self, current: PreparedFrame) -> WindowFrame:
        """The frame in the window of the current one."""
        image_from_bev = self.image_from_bev
        if self.stamp != current.frame.stamp:
            moved = other_bev_from_bev(current.frame.world_from_ego, self.pose, current.frame.rig.ego_from_bev)
            image_from_bev = image_from_bev @ torch.from_numpy(moved)
        height, width = current.images.shape[-2:]
        # The projections stay on the CPU, as the model reads them.
        return WindowFrame(self.image_features, image_from_bev.float(), self.has_image, (height, width))


@dataclass(frozen=True)
class FeatureWindow:
    """The memory of a BEVFormerV2."""

    frames: tuple[FrameFeatures, ...]  # the last ones, and with a model that looks ahead the next, by time

    def before(self, now: FrameStamp, count: int) -> list[FrameFeatures]:
        """The last `count` frames before the current one."""
        past = [frame for frame in self.frames if frame.stamp.timestamp_ns < now.timestamp_ns]
        return past[len(past) - min(count, len(past)) :]


def seen_in_clip(current: int, clip: Clip, features: FeatureMaps, index: int) -> WindowFrame:
    """The frames of training clips with an index, seen from the bev frames of the current ones."""
    inputs = clip.inputs[index]
    image_from_bev = inputs.image_from_bev
    if index != current:
        moved = torch.linalg.solve(clip.world_from_bev[index], clip.world_from_bev[current])
        image_from_bev = (image_from_bev.double() @ moved[:, None]).float()
    return WindowFrame(features, image_from_bev, inputs.has_image, inputs.image_size)


def frames_at(
    frames: Sequence[FrameFeatures], indices: Sequence[int], current: PreparedFrame
) -> list[WindowFrame | None]:
    """The frames at these indices, seen from the current one; None where there is no frame."""
    return [frames[index].seen_from(current) if 0 <= index < len(frames) else None for index in indices]


def kept(frames: Sequence[FrameFeatures], current: int, past_frames: int) -> FeatureWindow:
    """The memory for the next frame, which needs one frame less of the past. current: index of the current frame."""
    return FeatureWindow(tuple(frames[max(0, current + 1 - past_frames) :]))


def fill_window(frames: Sequence[int], exists: Sequence[bool]) -> list[int]:
    """For each frame of the window, the index of the frame whose BEV map it takes.

    That is its own, or, where it does not exist, that of the nearest existing frame towards the current one.

    Args:
        frames: frames of the window relative to the current one, ascending.
        exists: for each of them; the current one, 0, does.
    """
    current = list(frames).index(0)
    sources = list(range(len(frames)))
    for index in (*range(current - 1, -1, -1), *range(current + 1, len(frames))):
        if not exists[index]:
            sources[index] = sources[index + (1 if index < current else -1)]
    return sources


def other_bev_from_bev(world_from_ego: Pose, other_world_from_ego: Pose, ego_from_bev: Array) -> Array:
    """(4, 4) float64 from the bev frame now to the bev frame at another time.

    As in the released code, both times take the current pose of the bev frame in the vehicle, and the arithmetic is
    float32, so that the same cells are seen at the edges of images. Far from the world's origin float32 is too coarse;
    there it is float64.

    Args:
        world_from_ego: the vehicle's pose now.
        other_world_from_ego: the vehicle's pose at the other time.
        ego_from_bev: (4, 4), the current pose of the bev frame in the vehicle.
    """
    now, other = world_from_ego.matrix, other_world_from_ego.matrix
    far = max(np.abs(now[:3, 3]).max(), np.abs(other[:3, 3]).max()) > FLOAT32_RANGE_M
    dtype: type[np.floating] = np.float64 if far else np.float32
    offset = ego_from_bev.astype(dtype)
    bev_from_other_bev = np.linalg.inv(offset) @ np.linalg.inv(now.astype(dtype)) @ other.astype(dtype) @ offset
    moved: Array = np.linalg.inv(bev_from_other_bev).astype(np.float64)
    return moved


class WindowStep(ExportedStep):
    """One step of a BEVFormerV2 whose window ends with the current frame: `BEVFormerV2.forward`.

    The image features of the earlier frames enter, and those of the current frame come out. All frames are encoded,
    also those that do not exist, because a graph has no optional parts; a frame without any image then takes the map
    of the next one, as in `fill_window`.
    """

    def forward(
        self,
        images: Tensor,
        image_from_bev: Tensor,
        camera_index: Tensor,
        has_image: Tensor,
        previous_features: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """One step; `WindowForm` documents every input and output."""
        network = self.network
        image_features = self.image_features(images, camera_index)
        tokens = [*([] if previous_features is None else previous_features), image_features.tokens]
        hits = [self.hits(image_from_bev[:, index], has_image[:, index]) for index in range(len(tokens))]
        maps = [
            network.encoder(
                bev_query=network.bev_queries.embedding[None],
                position=network.bev_queries.position(),
                image_features=FeatureMaps(frame_tokens, image_features.level_shapes),
                hits=frame_hits,
            )
            for frame_tokens, frame_hits in zip(tokens, hits, strict=True)
        ]
        for index in reversed(range(len(maps) - 1)):
            maps[index] = torch.where(has_image[:, index].any(), maps[index], maps[index + 1])
        bev = maps[0] if network.fusion is None else network.fusion(maps)
        most_cameras = torch.cat([frame_hits.most_cameras for frame_hits in hits]).amax(0, keepdim=True)
        outputs = self.outputs(network.detect(bev), most_cameras)
        return outputs if previous_features is None else (*outputs, image_features.tokens)


class WindowForm(ExportForm):
    """The form of one step of a BEVFormerV2.

    Attributes:
        frames: of the window, relative to the current one, which is the last.
    """

    step = WindowStep

    def __init__(self, config: BEVFormerV2Config, cameras: int) -> None:
        """Raises BevcliError for a model that looks at later frames."""
        if config.later_frames:
            raise BevcliError(
                f"{config.name}: a model that looks at later frames cannot be exported: frames is "
                f"{list(config.frames)} (expected a window that ends with 0, the current frame)"
            )
        super().__init__(config, cameras)
        self.frames = config.frames

    @property
    def inputs(self) -> tuple[Port, ...]:
        lead, bev_frame = (1, len(self.frames), self.cameras), "the current frame's bev frame"
        images, projection, camera_index, has_image = camera_ports(self.config, lead, "1, F, N", bev_frame)
        window = (
            " For the cameras of each of the window's F frames, which are, relative to the current one: "
            f"{_listed(self.frames)}."
        )
        absent = (
            " All false for a frame that does not exist, such as before a scene's first frame or before a gap in "
            "time of more than max_gap_s: the BEV map of the next frame takes the place of its own."
        )
        projection = replace(projection, meaning=projection.meaning + window)
        ports = (images, projection, camera_index, replace(has_image, meaning=has_image.meaning + absent))
        if len(self.frames) == 1:
            return ports
        meaning = (
            "(F - 1, N, S, C): the output image_features of the window's earlier frames "
            f"{_listed(self.frames[:-1])}, in this order; ignored for a frame that does not exist."
        )
        return (*ports, Port("previous_features", (len(self.frames) - 1, *self._features_shape), meaning))

    def outputs(self, *, decode: bool) -> tuple[Port, ...]:
        ports = super().outputs(decode=decode)
        if len(self.frames) == 1:
            return ports
        meaning = "(N, S, C): of the current frame's images, for previous_features of the next frames."
        return (*ports, Port("image_features", self._features_shape, meaning))

    def facts(self) -> dict[str, Any]:
        return {"window": self.frames}

    def feed(self, prepared: PreparedFrame, memory: FeatureWindow | None) -> dict[str, Tensor]:
        """See `ExportForm`. Of a frame that does not exist no camera has an image."""
        past = self._past(prepared, memory)
        current = model_inputs(prepared, None, self.config)
        indices = [len(past) + offset for offset in self.frames[:-1]]
        absent = WindowFrame(
            FeatureMaps(torch.zeros(self._features_shape), self.config.level_shapes),
            torch.zeros_like(current.image_from_bev),
            torch.zeros_like(current.has_image),
            current.image_size,
        )
        earlier = [frame or absent for frame in frames_at(past, indices, prepared)]
        feed = camera_feed(current) | {
            "image_from_bev": torch.stack(
                [*(frame.image_from_bev for frame in earlier), current.image_from_bev], dim=1
            ),
            "has_image": torch.stack([*(frame.has_image for frame in earlier), current.has_image], dim=1),
        }
        if earlier:
            feed["previous_features"] = torch.stack([frame.image_features.tokens for frame in earlier])
        return feed

    def memory(
        self, prepared: PreparedFrame, memory: FeatureWindow | None, by_name: Mapping[str, Tensor]
    ) -> FeatureWindow:
        past = self._past(prepared, memory)
        if "image_features" not in by_name:
            return kept(past, len(past), -self.frames[0])
        features = FeatureMaps(by_name["image_features"], self.config.level_shapes)
        return kept([*past, FrameFeatures.of(prepared, features)], len(past), -self.frames[0])

    def _past(self, prepared: PreparedFrame, memory: FeatureWindow | None) -> list[FrameFeatures]:
        return [] if memory is None else memory.before(prepared.frame.stamp, -self.frames[0])

    @property
    def _features_shape(self) -> tuple[int, int, int]:
        cells = sum(height * width for height, width in self.config.level_shapes)
        return self.cameras, cells, self.config.channels


def _listed(frames: tuple[int, ...]) -> str:
    return ", ".join(map(str, frames))


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
