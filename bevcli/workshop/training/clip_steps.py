"""How a model goes through training clips, frame by frame: registered by its class, as "clip_steps CLASS"."""

from typing import Any, Protocol

import torch
from torch import Tensor

from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.bevformer_v2.bevformer_v2 import BEVFormerV2, WindowFrame
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.network import Network
from bevcli.model.step import ModelOutputs
from bevcli.registry import for_model
from bevcli.workshop.training.samples import Batch

WindowMemory = list[FeatureMaps]  # the image features of all frames of the clip so far


class ClipSteps(Protocol):
    """A model and the frames of B clips, in turn. The memory of the first frame is None."""

    def __init__(self, model: Any) -> None: ...

    def history(self, clip: Batch, frame: int, memory: Any) -> Any:
        """The memory after a frame that is history only; called without gradient."""

    def outputs(self, clip: Batch, frame: int, memory: Any) -> tuple[ModelOutputs, Any]:
        """The outputs for a frame, and the memory after it, which has no gradient."""


def clip_steps(model: Network) -> ClipSteps:
    """The steps of a model through clips."""
    steps: ClipSteps = for_model("clip_steps", type(model))[0](model)
    return steps


class RecurrentSteps:
    """Of a BEVFormer: the memory of a clip is its BEV map (B, Y·X, C)."""

    def __init__(self, model: BEVFormer) -> None:
        self._model = model

    def history(self, clip: Batch, frame: int, memory: Tensor | None) -> Tensor:
        """See `ClipSteps`."""
        bev: Tensor = self._model.compute(self._model.geometry(clip.inputs[frame], memory), False)
        return bev

    def outputs(self, clip: Batch, frame: int, memory: Tensor | None) -> tuple[ModelOutputs, Tensor]:
        """See `ClipSteps`."""
        outputs = self._model(clip.inputs[frame], memory)
        return outputs, outputs.bev.detach()


class WindowSteps:
    """Of a BEVFormerV2: its BEV encoder and its fusion are trained on the whole window."""

    def __init__(self, model: BEVFormerV2) -> None:
        self._model = model

    def history(self, clip: Batch, frame: int, memory: WindowMemory | None) -> WindowMemory:
        """See `ClipSteps`."""
        inputs = clip.inputs[frame]
        return [*(memory or ()), self._model.image_features(inputs.images, inputs.camera_index)]

    def outputs(self, clip: Batch, frame: int, memory: WindowMemory | None) -> tuple[ModelOutputs, WindowMemory]:
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
