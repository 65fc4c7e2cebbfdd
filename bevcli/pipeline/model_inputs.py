"""Preprocessed frames of several sequences as the inputs of one step of the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from bevcli.errors import InputError
from bevcli.geometry.transforms import Pose
from bevcli.model.bevformer import BEVFormerConfig, BEVFormerInputs
from bevcli.model.ego_motion import EgoMotionInputs, ego_motion_inputs
from bevcli.pipeline.preprocess import PreparedFrame


def model_inputs(
    frames: Sequence[PreparedFrame], previous_poses: Sequence[Pose | None], config: BEVFormerConfig
) -> BEVFormerInputs:
    """B frames, each of another sequence, as a batch.

    Args:
        frames: B preprocessed frames.
        previous_poses: world_from_ego of the frame before in each sequence; None at its start.
        config: of the model.

    Raises:
        InputError: the sequences do not have the same number of cameras.
    """
    indices = [prepared.camera_index for prepared in frames]
    for prepared in frames:
        if len(prepared.camera_index) != len(indices[0]):
            raise InputError(
                f"cameras {', '.join(prepared.assignment.cameras)} and {', '.join(frames[0].assignment.cameras)} "
                "cannot go into one batch: use sequences with the same number of cameras, or batches of 1"
            )
    same = all(torch.equal(index, indices[0]) for index in indices)
    motions = [_motion(prepared, pose, config) for prepared, pose in zip(frames, previous_poses, strict=True)]
    return BEVFormerInputs(
        # Copying the images of a single frame would take milliseconds.
        images=frames[0].images if len(frames) == 1 else _together([prepared.images for prepared in frames]),
        image_from_bev=torch.cat([prepared.image_from_bev for prepared in frames]).float(),
        camera_index=indices[0] if same else torch.stack(indices),
        has_image=torch.cat([prepared.has_image for prepared in frames]),
        can_bus=torch.from_numpy(np.stack([motion.can_bus for motion in motions])),
        shift=torch.from_numpy(np.stack([motion.shift for motion in motions])),
        rotation_deg=torch.tensor([motion.rotation_deg for motion in motions], dtype=torch.float32),
    )


def _together(images: list[Tensor]) -> Tensor:
    """Images (1, N, 3, H, W) of several frames, padded with zeros at right and bottom to the largest of them."""
    height, width = (max(of_frame.shape[axis] for of_frame in images) for axis in (-2, -1))
    padded = [F.pad(one, (0, width - one.shape[-1], 0, height - one.shape[-2])) for one in images]
    return torch.cat(padded)


def _motion(prepared: PreparedFrame, previous_pose: Pose | None, config: BEVFormerConfig) -> EgoMotionInputs:
    frame = prepared.frame
    return ego_motion_inputs(
        frame.world_from_ego,
        previous_pose,
        frame.kinematics.acceleration,
        frame.kinematics.angular_rate,
        frame.kinematics.velocity,
        config.bev_grid,
        config.ego_motion,
    )
