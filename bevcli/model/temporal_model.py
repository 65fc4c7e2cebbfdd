"""The protocol of a model: frame by frame through a sequence, with a memory that goes in and comes out.

A network, the same network prepared for inference, and an exported file are each a `TemporalModel`.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from bevcli.errors import BevcliError
from bevcli.frame import BevMap, FrameResult, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.model.box_coding import decode
from bevcli.model.config import ModelConfig
from bevcli.model.segmentation import decode_map
from bevcli.model.step import ModelOutputs, PreparedFrame, SceneAttention
from bevcli.registry import load
from bevcli.workshop.engines.export_form import ExportForm

Memory = Any  # a frozen dataclass of the model's own; whoever runs the model only passes it on


class TemporalModel(nn.Module):
    """A model with a memory between frames. A class registered under `bevcli.models` is built from its configuration.

    `step` decides a model's results; everything else has a default. The configuration says what the model needs of a
    sequence: see `ModelConfig`. The methods `decode_…` read nothing but `config`, as an exported file has no more.

    Attributes:
        config_class: class of the configuration, which a TOML file fills in.
        memory_type: class of the memory, by which the state of an interrupted run is read.
        official_names: patterns of key names in the released weights file, and ours; see `from_official`.
        stages: name of a submodule -> stage of the step that ends with it, for the times of a run.
        has_parts: the network has the parts of `bevcli.model.network.Network`, which probes and figures look into.
        device_parts: names of the methods that are pure functions of tensors on the device: no wait for it, no upload,
            no shape that depends on a tensor's numbers. On a CUDA GPU each becomes a CUDA graph.
        figures: of `bevcli explain`, as texts "module:attribute", each of a dict of functions by step. () for none.
        takes_pixels: the images enter before normalisation: see `PreparedFrame.pixels`.
        config: of the model.
    """

    config_class: ClassVar[type[ModelConfig]] = ModelConfig
    memory_type: ClassVar[type] = type(None)
    official_names: ClassVar[tuple[tuple[str, Any], ...]] = ()
    stages: Mapping[str, str] = {}
    has_parts: bool = False
    device_parts: ClassVar[tuple[str, ...]] = ()
    figures: ClassVar[tuple[str, ...]] = ()
    takes_pixels: ClassVar[bool] = False

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

    def decode_boxes(self, outputs: ModelOutputs) -> Boxes3D:
        """The boxes, best score first, bev frame."""
        return decode(outputs, self.config)

    def decode_map(self, outputs: ModelOutputs) -> BevMap | None:
        """The map of the ground, or None."""
        if outputs.segmentation is None:
            return None
        return decode_map(outputs.segmentation, self.config.segmentation, self.config.bev_grid)

    def decode_results(self, outputs: ModelOutputs) -> tuple[FrameResult, ...]:
        """The further results, of the types of `ModelConfig.results`."""
        return ()

    def scene_attentions(self, outputs: ModelOutputs, place: tuple[float, float]) -> Mapping[str, SceneAttention]:
        """Attention to objects and lines of the map by the attending part, for figures. {} for a model without such.

        outputs: of a batch of one. place: x and y in metres, bev frame, of the object whose attention is asked for.
        """
        return {}

    @property
    def device(self) -> torch.device:
        """The device of the weights."""
        return next(self.parameters()).device

    @property
    def image_parts(self) -> tuple[nn.Module, ...]:
        """The parts that compute in the precision of a run, first the one that the images enter."""
        return ()

    def exchange_parts(self) -> None:
        """Exchange, in place, parts whose result is the same in every frame; see `prepare_for_inference`."""

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> ExportForm:
        """The form that is exported for a number of cameras. Raises BevcliError for a model that has none."""
        raise BevcliError(f"{config.name}: a {config.architecture} cannot be exported")

    @classmethod
    def with_past(cls, memory: Memory, past: Sequence[tuple[FrameStamp, Pose]]) -> Memory:
        """A memory, for timing, as if the model had seen earlier frames too; past: their stamps and world_from_ego."""
        return memory

    @classmethod
    def without_training_parts(cls, state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
        """A state dict of a released file, without the parts that only training uses, and these parts in words."""
        return dict(state), ""

    @classmethod
    def part_names(cls, config: ModelConfig) -> Iterable[tuple[str, ...]]:
        """The name of each part, then its modules, in the order of a frame's way; a model may lack some."""
        return ()


def model_class(config: ModelConfig) -> type[TemporalModel]:
    """The registered model that a configuration is for."""
    found: type[TemporalModel] = load("bevcli.models", config.architecture)
    return found


def build_model(config: ModelConfig) -> TemporalModel:
    """The model of a configuration, with random weights."""
    return model_class(config)(config)
