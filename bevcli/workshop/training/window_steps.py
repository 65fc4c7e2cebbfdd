"""How a BEVFormerV2 goes through training clips."""

import torch

from bevcli.model.bevformer_v2.bevformer_v2 import BEVFormerV2
from bevcli.model.bevformer_v2.window import WindowFrame
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.step import ModelOutputs
from bevcli.workshop.training.samples import Batch

Memory = list[FeatureMaps]  # the image features of all frames of the clip so far


class WindowSteps:
    """See `ClipSteps`. The BEV encoder and the fusion are trained on the whole window."""

    def __init__(self, model: BEVFormerV2) -> None:
        self._model = model

    def history(self, clip: Batch, frame: int, memory: Memory | None) -> Memory:
        """See `ClipSteps`."""
        inputs = clip.inputs[frame]
        return [*(memory or ()), self._model.image_features(inputs.images, inputs.camera_index)]

    def outputs(self, clip: Batch, frame: int, memory: Memory | None) -> tuple[ModelOutputs, Memory]:
        """See `ClipSteps`."""
        features = self.history(clip, frame, memory)
        indices = [frame + offset for offset in self._model.config.frames]
        window = [_seen_from(frame, clip, features[index], index) if index >= 0 else None for index in indices]
        return self._model(window), [FeatureMaps(maps.tokens.detach(), maps.level_shapes) for maps in features]


def _seen_from(current: int, clip: Batch, features: FeatureMaps, index: int) -> WindowFrame:
    """The frames of the clips with an index, seen from the bev frames of the current ones."""
    inputs = clip.inputs[index]
    image_from_bev = inputs.image_from_bev
    if index != current:
        moved = torch.linalg.solve(clip.world_from_bev[index], clip.world_from_bev[current])
        image_from_bev = (image_from_bev.double() @ moved[:, None]).float()
    return WindowFrame(features, image_from_bev, inputs.has_image, inputs.image_size)
