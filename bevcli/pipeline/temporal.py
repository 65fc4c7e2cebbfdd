"""What a run remembers from frame to frame.

BEVFormer remembers the last BEV map, BEVFormerV2 the image features of its window, UniAD the last BEV map and the
tracks.

`temporal_model` wraps a model so that the runner drives both in the same way: memory goes in and comes out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from bevcli.engines.exported import ExportedBEVFormerV2, ExportedWindowOutputs
from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Array, Pose, inverse
from bevcli.model.bevformer import BEVFormer, BEVFormerBase, BEVFormerOutputs
from bevcli.model.bevformer_v2 import BEVFormerV2, BEVFormerV2Config, WindowFrame
from bevcli.model.deformable_attention import FeatureMaps, LevelShapes
from bevcli.model.track_queries import FrameMotion, TrackQueries
from bevcli.model.uniad import UniAD, UniADOutputs
from bevcli.model.upload import upload
from bevcli.pipeline.model_inputs import model_inputs
from bevcli.pipeline.preprocess import PreparedFrame

# Metres. Where poses are nearer to the world's origin, float32 holds them to a millimetre. nuScenes' maps reach 3 km.
FLOAT32_RANGE_M = 10_000


@dataclass(frozen=True)
class BevHistory:
    """What BEVFormer remembers.

    Attributes:
        bev: (1, Y·X, C), the BEV map of the last frame.
        pose: world_from_ego of that frame.
    """

    bev: Tensor
    pose: Pose


@dataclass(frozen=True)
class FrameFeatures:
    """The image features of one frame and where its cameras were.

    Attributes:
        stamp: of the frame.
        pose: its world_from_ego.
        tokens: (N, S, C) of its N images, in the dtype of the model's image features.
        level_shapes: (height, width) of each feature level.
        image_from_bev: (1, N, 4, 4) float64 on the CPU, from the frame's own bev metres to network pixels.
        has_image: (1, N) bool.
    """

    stamp: FrameStamp
    pose: Pose
    tokens: Tensor
    level_shapes: LevelShapes
    image_from_bev: Tensor
    has_image: Tensor


@dataclass(frozen=True)
class FeatureWindow:
    """What BEVFormerV2 remembers.

    Attributes:
        frames: the last frames, and with a model that looks ahead the next ones, in order of time.
    """

    frames: tuple[FrameFeatures, ...]


@dataclass(frozen=True)
class TrackHistory:
    """What UniAD remembers.

    Attributes:
        bev: (1, Y·X, C), the BEV map of the last frame; None where a scene has ended.
        tracks: of the last frame, with their memories.
        pose: world_from_ego of that frame.
        ego_from_bev: (4, 4) of that frame.
        timestamp_ns: of that frame.
    """

    bev: Tensor | None
    tracks: TrackQueries
    pose: Pose
    ego_from_bev: Array
    timestamp_ns: int


Memory = BevHistory | FeatureWindow | TrackHistory


class TemporalModel(Protocol):
    """A model with its memory, of any kind.

    Attributes:
        later_frames: how many frames after the current one the model looks at.
        uses_history: whether earlier or later frames change the result at all.
    """

    @property
    def later_frames(self) -> int: ...

    @property
    def uses_history(self) -> bool: ...

    def step(
        self, prepared: PreparedFrame, memory: Memory | None, upcoming: Sequence[PreparedFrame]
    ) -> tuple[BEVFormerOutputs, Memory]:
        """One frame.

        Args:
            prepared: the frame.
            memory: what the step of the frame before returned; where the history starts anew, what `restarted` makes
                of it.
            upcoming: the next `later_frames` frames that have images; fewer at the end of a scene.
        """
        ...

    def restarted(self, memory: Memory) -> Memory | None:
        """What remains of a memory where the history starts anew; None for nothing."""
        ...


def temporal_model(model: BEVFormerBase, device: torch.device) -> TemporalModel:
    """The model with the memory of its kind."""
    if isinstance(model, BEVFormerV2):
        return Window(model, device)
    if isinstance(model, ExportedBEVFormerV2):
        return ExportedWindow(model)
    if isinstance(model, UniAD):
        return TrackRecurrence(model, device)
    assert isinstance(model, BEVFormer)
    return Recurrence(model, device)


class Recurrence:
    """A BEVFormer: the BEV map of a frame is the history of the next."""

    later_frames = 0
    uses_history = True

    def __init__(self, model: BEVFormer, device: torch.device) -> None:
        self.model, self.device = model, device

    def step(
        self, prepared: PreparedFrame, memory: Memory | None, upcoming: Sequence[PreparedFrame]
    ) -> tuple[BEVFormerOutputs, BevHistory]:
        """See `TemporalModel.step`."""
        assert memory is None or isinstance(memory, BevHistory)
        previous_pose = None if memory is None else memory.pose
        inputs = model_inputs([prepared], [previous_pose], self.model.config)
        inputs = inputs.to(self.device, keep_geometry=True)
        outputs = self.model(inputs, None if memory is None else memory.bev)
        return outputs, BevHistory(outputs.bev, prepared.frame.world_from_ego)

    def restarted(self, memory: Memory) -> None:
        """See `TemporalModel.restarted`."""


class TrackRecurrence:
    """A UniAD: BEV map and tracks of a frame go on to the next. Identities stay different over all scenes of a run."""

    later_frames = 0
    uses_history = True

    def __init__(self, model: UniAD, device: torch.device) -> None:
        self.model, self.device = model, device

    def step(
        self, prepared: PreparedFrame, memory: Memory | None, upcoming: Sequence[PreparedFrame]
    ) -> tuple[UniADOutputs, TrackHistory]:
        """See `TemporalModel.step`."""
        assert memory is None or isinstance(memory, TrackHistory)
        frame, config = prepared.frame, self.model.config
        is_known = memory is not None and (memory.bev is not None or config.ego_motion.first_frame == "original")
        previous_pose = memory.pose if memory is not None and is_known else None
        inputs = model_inputs([prepared], [previous_pose], config).to(self.device)
        history = tracks = motion = None
        if memory is not None:
            history = None if memory.bev is None else memory.bev.to(self.device)
            tracks, motion = memory.tracks.to(self.device), self._motion(prepared, memory)
        outputs: UniADOutputs = self.model(inputs, history, tracks, motion)
        return outputs, TrackHistory(
            outputs.bev,
            outputs.tracks,
            frame.world_from_ego,
            frame.rig.ego_from_bev,
            frame.stamp.timestamp_ns,
        )

    def restarted(self, memory: Memory) -> TrackHistory:
        """See `TemporalModel.restarted`: the next identity, and the pose for EgoMotionConfig.first_frame "original"."""
        assert isinstance(memory, TrackHistory)
        return replace(memory, bev=None, tracks=memory.tracks.ended())

    def _motion(self, prepared: PreparedFrame, memory: TrackHistory) -> FrameMotion:
        frame = prepared.frame
        world_from_bev = frame.world_from_ego.matrix @ frame.rig.ego_from_bev
        bev_from_previous_bev = inverse(world_from_bev) @ memory.pose.matrix @ memory.ego_from_bev
        seconds = (frame.stamp.timestamp_ns - memory.timestamp_ns) / 1e9
        return FrameMotion(torch.from_numpy(bev_from_previous_bev).float().to(self.device), seconds)


class FrameWindow:
    """What the windows of a BEVFormerV2 and of an exported one share: which frames they see, and from where."""

    def __init__(self, config: BEVFormerV2Config) -> None:
        self.config = config

    @property
    def later_frames(self) -> int:
        """See `TemporalModel`."""
        return self.config.later_frames

    @property
    def uses_history(self) -> bool:
        """See `TemporalModel`."""
        return len(self.config.frames) > 1

    def restarted(self, memory: Memory) -> None:
        """See `TemporalModel.restarted`."""

    def past(self, known: Sequence[FrameFeatures], now: FrameStamp) -> list[FrameFeatures]:
        """The known frames before the current one that the window reaches."""
        past = [frame for frame in known if frame.stamp.timestamp_ns < now.timestamp_ns]
        return past[len(past) - min(self.config.past_frames, len(past)) :]

    def placed(
        self, frames: Sequence[FrameFeatures], current: PreparedFrame, places: Sequence[int]
    ) -> list[WindowFrame | None]:
        """The frames at these places, seen from the bev frame of the current one; None where there is no frame."""
        return [self._placed(frames[place], current) if 0 <= place < len(frames) else None for place in places]

    def kept(self, frames: Sequence[FrameFeatures], current: int) -> FeatureWindow:
        """What the next frame needs, which is one frame less of the past. current: place of the current frame."""
        return FeatureWindow(tuple(frames[max(0, current + 1 - self.config.past_frames) :]))

    def _placed(self, frame: FrameFeatures, current: PreparedFrame) -> WindowFrame:
        image_from_bev = frame.image_from_bev
        if frame.stamp != current.frame.stamp:
            moved = other_bev_from_bev(current.frame.world_from_ego, frame.pose, current.frame.rig.ego_from_bev)
            image_from_bev = image_from_bev @ torch.from_numpy(moved)
        height, width = current.images.shape[-2:]
        return WindowFrame(
            image_features=FeatureMaps(frame.tokens, frame.level_shapes),
            image_from_bev=image_from_bev.float(),  # on the CPU, as the model reads it
            has_image=frame.has_image,
            image_size=(height, width),
        )


class Window(FrameWindow):
    """A BEVFormerV2: a window of frames, whose images pass the backbone once."""

    def __init__(self, model: BEVFormerV2, device: torch.device) -> None:
        super().__init__(model.config)
        self.model, self.device = model, device

    def step(
        self, prepared: PreparedFrame, memory: Memory | None, upcoming: Sequence[PreparedFrame]
    ) -> tuple[BEVFormerOutputs, FeatureWindow]:
        """See `TemporalModel.step`."""
        assert memory is None or isinstance(memory, FeatureWindow)
        known = {} if memory is None else {frame.stamp: frame for frame in memory.frames}
        past = self.past(list(known.values()), prepared.frame.stamp)
        present = [known.get(one.frame.stamp) or self._features(one) for one in (prepared, *upcoming)]
        frames, current = (*past, *present), len(past)
        places = [current + offset for offset in self.config.frames]
        outputs: BEVFormerOutputs = self.model(self.placed(frames, prepared, places))
        return outputs, self.kept(frames, current)

    def _features(self, prepared: PreparedFrame) -> FrameFeatures:
        images, camera_index = (upload(x, self.device) for x in (prepared.images, prepared.camera_index))
        return frame_features(prepared, self.model.image_features(images, camera_index))


class ExportedWindow(FrameWindow):
    """An exported BEVFormerV2: the image features of the current frame come out of its step."""

    def __init__(self, model: ExportedBEVFormerV2) -> None:
        super().__init__(model.config)
        self.model = model

    def step(
        self, prepared: PreparedFrame, memory: Memory | None, upcoming: Sequence[PreparedFrame]
    ) -> tuple[BEVFormerOutputs, FeatureWindow]:
        """See `TemporalModel.step`."""
        assert memory is None or isinstance(memory, FeatureWindow)
        past = self.past(() if memory is None else memory.frames, prepared.frame.stamp)
        places = [len(past) + offset for offset in self.config.frames[:-1]]
        inputs = model_inputs([prepared], [None], self.config)
        outputs: ExportedWindowOutputs = self.model(inputs, self.placed(past, prepared, places))
        found = outputs.image_features
        present = [] if found is None else [frame_features(prepared, found)]
        return outputs, self.kept([*past, *present], len(past))


def frame_features(prepared: PreparedFrame, features: FeatureMaps) -> FrameFeatures:
    """What a window keeps of a frame."""
    return FrameFeatures(
        stamp=prepared.frame.stamp,
        pose=prepared.frame.world_from_ego,
        tokens=features.tokens,
        level_shapes=features.level_shapes,
        image_from_bev=prepared.image_from_bev,
        has_image=prepared.has_image,
    )


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
