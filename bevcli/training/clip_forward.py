"""The forward passes of a clip: the last frame, or every frame, in training mode; the frames before it as history.

A BEVFormer passes its BEV map from frame to frame. A BEVFormerV2 encodes a window of frames in the current BEV grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormer, BEVFormerBase, BEVFormerInputs, BEVFormerOutputs
from bevcli.model.bevformer_v2 import BEVFormerV2, WindowFrame
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.training.samples import Batch


def forward_clip(
    model: BEVFormerBase, batch: Batch, *, learn_all: bool = False, freeze_batch_norm: bool = False
) -> Iterator[BEVFormerOutputs]:
    """The outputs, in training mode, for the last frame of a batch of clips.

    The frames before it only build its history, in evaluation mode and without gradient, as in the papers. Of a
    BEVFormerV2, this applies to the image features of the earlier frames; the BEV encoder and the fusion are trained on
    the whole window.

    Args:
        batch: the clips.
        learn_all: yield the outputs for every frame. The model may be updated in between: history has no gradient.
        freeze_batch_norm: keep batch norms in evaluation mode, for fine-tuning.
    """
    if isinstance(model, BEVFormerV2):
        return _window(model, batch, learn_all, freeze_batch_norm)
    assert isinstance(model, BEVFormer)
    return _recurrence(model, batch.inputs, learn_all, freeze_batch_norm)


def _recurrence(
    model: BEVFormer, clip: Sequence[BEVFormerInputs], learn_all: bool, freeze_batch_norm: bool
) -> Iterator[BEVFormerOutputs]:
    history: Tensor | None = None
    history_only = () if learn_all else clip[:-1]
    model.eval()
    with torch.no_grad():
        for inputs in history_only:
            history = model.bev_map(inputs, history)
    _switch_to_training(model, freeze_batch_norm)
    for inputs in clip[len(history_only) :]:
        outputs = model(inputs, history)
        history = outputs.bev.detach()
        yield outputs


def _window(model: BEVFormerV2, batch: Batch, learn_all: bool, freeze_batch_norm: bool) -> Iterator[BEVFormerOutputs]:
    first_learned = 0 if learn_all else len(batch.inputs) - 1
    model.eval()
    with torch.no_grad():
        features = [_image_features(model, inputs) for inputs in batch.inputs[:first_learned]]
    _switch_to_training(model, freeze_batch_norm)
    for current, inputs in enumerate(batch.inputs[first_learned:], first_learned):
        features.append(_image_features(model, inputs))
        places = [current + offset for offset in model.config.frames]
        outputs: BEVFormerOutputs = model(
            [_window_frame(batch, features[place], place, current) if place >= 0 else None for place in places]
        )
        features[-1] = FeatureMaps(features[-1].tokens.detach(), features[-1].level_shapes)
        yield outputs


def _image_features(model: BEVFormerV2, inputs: BEVFormerInputs) -> FeatureMaps:
    return model.image_features(inputs.images, inputs.camera_index)


def _window_frame(batch: Batch, features: FeatureMaps, place: int, current: int) -> WindowFrame:
    """The frames at a place of the clips, seen from the bev frames of the current ones."""
    inputs = batch.inputs[place]
    image_from_bev = inputs.image_from_bev
    if place != current:
        moved = torch.linalg.solve(batch.world_from_bev[place], batch.world_from_bev[current])
        image_from_bev = (image_from_bev.double() @ moved[:, None]).float()
    return WindowFrame(features, image_from_bev, inputs.has_image, inputs.image_size)


def _switch_to_training(model: nn.Module, freeze_batch_norm: bool) -> None:
    model.train()
    if freeze_batch_norm:
        for module in model.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
