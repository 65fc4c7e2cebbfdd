"""The configuration of a BEVFormerV2, its memory (the image features of a window of frames) and its exported form."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from bevcli.errors import BevcliError, ConfigError
from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Array, Pose
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.ego_motion import EgoMotionConfig
from bevcli.model.step import Clip, PreparedFrame, model_inputs
from bevcli.workshop.engines.export_form import ExportedStep, ExportForm, Port, camera_feed, camera_ports

NO_EGO_MOTION = EgoMotionConfig(can_bus=False, shift=False, rotation=False)
# Metres. Where poses are nearer to the world's origin, float32 holds them to a millimetre. nuScenes' maps reach 3 km.
FLOAT32_RANGE_M = 10_000
ClipMemory = list[FeatureMaps]  # the image features of all frames of training clips so far


@dataclass(frozen=True)
class BevFusionConfig:
    """The fusion of the window's BEV maps."""

    blocks: int = 3  # number of residual blocks
    # channels of the blocks. Where the concatenated maps have another number of channels, the first block's shortcut is
    # a convolution
    width: int = 512

    def __post_init__(self) -> None:
        if min(self.blocks, self.width) < 1:
            raise ValueError("blocks and width must be positive")


@dataclass(frozen=True, kw_only=True)
class BEVFormerV2Config(ModelConfig):
    """A whole BEVFormerV2. Levels of the neck beyond the level embeddings are for training only."""

    architecture: ClassVar[str] = "BEVFormerV2"
    trains_with_gaps: ClassVar[bool] = False
    trains_with_more_levels: ClassVar[bool] = True

    # the frames of the window, relative to the current one, in the order of fusion: [-1, 0] is the previous frame and
    # the current one. Positive numbers are later frames (offline use)
    frames: tuple[int, ...]
    # fuses the BEV maps of the window; unused where the window has only one frame
    fusion: BevFusionConfig = field(default_factory=BevFusionConfig)
    # switched off; the poses enter by the projections of the window's frames
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

    # the last frames, and with a model that looks ahead the next ones, in order of time
    frames: tuple[FrameFeatures, ...]

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
