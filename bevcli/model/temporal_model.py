"""The protocol of a model: frame by frame through a sequence, with a memory that goes in and comes out.

A network, the same network prepared for inference, and an exported file are each a `TemporalModel`.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from bevcli.errors import BevcliError
from bevcli.frame import BevMap, FrameResult, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.model.config import ModelConfig
from bevcli.model.segmentation import decode_map
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.registry import load

Memory = Any  # a frozen dataclass of the model's own; whoever runs the model only passes it on
Renames = Sequence[tuple[str, str | Callable[[re.Match[str]], str]]]


@dataclass(frozen=True)
class OfficialNames:
    """The names of tensors in the released files of a model, beside those that all models share."""

    mark: str = ""  # pattern of a key that only these files have; "" for a model with shared names only
    renames: Renames = ()  # pattern of the official name, and ours, in the order of use
    unused: str = ""  # pattern of the keys without effect at inference, which are left out
    unused_text: str = "{count} keys, such as {first}"  # those in words, with their `count` and the `first` of them

    def without_unused(self, state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
        """The state dict without the unused keys, and these in words."""
        unused = [key for key in state if self.unused and re.match(self.unused, key)]
        text = self.unused_text.format(count=len(unused), first=unused[0]) if unused else ""
        return {key: tensor for key, tensor in state.items() if key not in unused}, text


class TemporalModel(nn.Module):
    """A model with a memory between frames. A class registered under `bevcli.models` is built from its configuration.

    `step` decides a model's results; everything else has a default. The configuration says what the model needs of a
    sequence: see `ModelConfig`.

    Attributes:
        config_class: class of the configuration, which a TOML file fills in.
        memory_type: class of the memory, by which the state of an interrupted run is read.
        outputs_type: class of the outputs.
        waits_within_step: the CPU reads of the device within a step: no frame is begun before the last one ends.
        official_names: of the tensors in the released files of the model.
        stages: name of a submodule -> stage of the step that ends with it, for the times of a run.
        config: of the model.
    """

    config_class: ClassVar[type[ModelConfig]] = ModelConfig
    memory_type: ClassVar[type] = type(None)
    outputs_type: ClassVar[type[ModelOutputs]] = ModelOutputs
    waits_within_step: ClassVar[bool] = False
    official_names: ClassVar[OfficialNames] = OfficialNames()
    stages: Mapping[str, str] = {}

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config

    def step(
        self, prepared: PreparedFrame, memory: Memory | None, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[ModelOutputs, Memory]:
        """The outputs of one frame, for a batch of one, and the memory for the next.

        Args:
            prepared: the frame, on the CPU; its images may be on the model's device already.
            memory: what the step of the frame before returned; where the history starts anew, what `restarted` makes
                of it.
            upcoming: the next `config.later_frames` frames that have images; fewer at the end of a scene.
        """
        raise NotImplementedError

    def restarted(self, memory: Memory) -> Memory | None:
        """Memory kept across a history reset, or None."""
        return None

    def with_pose(self, memory: Memory, pose: Pose) -> Memory:
        """The memory with another world_from_ego of its newest frame, as live motion knows it better a frame later.

        Raises BevcliError for a model that has not stated where its memory holds the pose.
        """
        raise BevcliError(
            f"{self.config.name}: a {self.config.architecture} cannot run without poses: it has no `with_pose`, which "
            "corrects the pose in its memory: pass poses"
        )

    def with_past(self, memory: Memory, past: Sequence[tuple[FrameStamp, Pose]]) -> Memory:
        """The memory after one frame as if the model had seen earlier frames too, to be timed.

        past: their stamps and world_from_ego.
        """
        return memory

    def decode(self, outputs: ModelOutputs) -> Iterator[Boxes3D | BevMap | FrameResult]:
        """Yields the boxes, best score first, bev frame; the map of the ground, if there is one; further results.

        Nothing but `config` is read of the model, as an exported file has no more.
        """
        yield outputs.boxes(self.config)
        if outputs.segmentation is not None:
            yield decode_map(outputs.segmentation, self.config.segmentation, self.config.bev_grid)

    def fix_constant_parts(self) -> None:
        """Compute once, in place, what is the same in every frame. A copy of the model for inference is changed."""

    def part_names(self) -> Iterator[tuple[str, ...]]:
        """The name of each part in the paper's terms, then its modules, in the order of a frame's way.

        The model may lack some. A module that no part names is one of its own.
        """
        yield from ()

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> Any:
        """The `ExportForm` in which `bevcli export-onnx` writes the model for a number of cameras.

        Raises BevcliError for a model that cannot be exported.
        """
        raise BevcliError(f"{config.name}: a {config.architecture} cannot be exported")

    @property
    def device(self) -> torch.device:
        """The device of the weights."""
        return next(self.parameters()).device


def model_class(config: ModelConfig) -> type[TemporalModel]:
    """The registered model that a configuration is for."""
    registered: type[TemporalModel] = load("bevcli.models", config.architecture)
    return registered


def build_model(config: ModelConfig) -> TemporalModel:
    """The model of a configuration, with random weights."""
    return model_class(config)(config)
