"""How a model goes through training clips, frame by frame: registered by its class, as "clip_steps CLASS"."""

from typing import Any, Protocol

from torch import Tensor

from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.network import Network
from bevcli.model.step import ModelOutputs
from bevcli.registry import for_model
from bevcli.workshop.training.samples import Batch


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
