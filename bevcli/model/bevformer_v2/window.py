r"""The window of a BEVFormerV2: the frames that a step sees, and the image features that are kept for the next steps.

A window [-2, -1, 0] at frame 1, the second of its scene; frame -1 does not exist:

    images           (none)     frame 0      frame 1        each passes the backbone once
    image features   (none)     kept         new            `FeatureWindow` keeps frame 0 and 1 for frame 2
                                  |            |            `seen_from`: frame 0's cameras in frame 1's bev frame
    BEV encoder                   |            |            the same weights, grid of frame 1, no history
    BEV map          frame 0's  frame 0's    frame 1's      `fill_window`: that of the nearest frame towards 0
                        \_________|____________/
                               BevFusion                    -> the BEV map of frame 1
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Array, Pose
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.step import PreparedFrame

# Metres. Where poses are nearer to the world's origin, float32 holds them to a millimetre. nuScenes' maps reach 3 km.
FLOAT32_RANGE_M = 10_000


@dataclass(frozen=True)
class WindowFrame:
    """One frame of the window of B sequences with N cameras.

    Attributes:
        image_features: tokens of the B·N images.
        image_from_bev: (B, N, 4, 4) float32, from the current frame's bev metres to pixels of this frame's images.
        has_image: (B, N) bool; a camera without an image sees no BEV cell.
        image_size: (height, width) of the network's input, pixels.
    """

    image_features: FeatureMaps
    image_from_bev: Tensor
    has_image: Tensor
    image_size: tuple[int, int]


@dataclass(frozen=True)
class FrameFeatures:
    """The image features of one frame and where its cameras were.

    Attributes:
        stamp: of the frame.
        pose: its world_from_ego.
        image_features: tokens of its N images.
        image_from_bev: (1, N, 4, 4) float64 on the CPU, from the frame's own bev metres to network pixels.
        has_image: (1, N) bool.
    """

    stamp: FrameStamp
    pose: Pose
    image_features: FeatureMaps
    image_from_bev: Tensor
    has_image: Tensor

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
    """The memory of a BEVFormerV2.

    Attributes:
        frames: the last frames, and with a model that looks ahead the next ones, in order of time.
    """

    frames: tuple[FrameFeatures, ...]

    def before(self, now: FrameStamp, count: int) -> list[FrameFeatures]:
        """The last `count` frames before the current one."""
        past = [frame for frame in self.frames if frame.stamp.timestamp_ns < now.timestamp_ns]
        return past[len(past) - min(count, len(past)) :]


def frames_at(
    frames: Sequence[FrameFeatures], indices: Sequence[int], current: PreparedFrame
) -> list[WindowFrame | None]:
    """The frames at these indices, seen from the current one; None where there is no frame."""
    return [frames[index].seen_from(current) if 0 <= index < len(frames) else None for index in indices]


def kept(frames: Sequence[FrameFeatures], current: int, past_frames: int) -> FeatureWindow:
    """The memory for the next frame, which needs one frame less of the past. current: place of the current frame."""
    return FeatureWindow(tuple(frames[max(0, current + 1 - past_frames) :]))


def fill_window(frames: Sequence[int], exists: Sequence[bool]) -> list[int]:
    """For each frame of the window, the place of the frame whose BEV map it takes.

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
