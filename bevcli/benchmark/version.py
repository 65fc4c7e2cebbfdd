"""One version of a model under test: its runner, its history, its times and its last answers."""

from __future__ import annotations

import time

import torch
from torch import nn

from bevcli.benchmark.limits import wait_for
from bevcli.frame import Prediction
from bevcli.model.bevformer import BEVFormer, BEVFormerOutputs
from bevcli.pipeline.preprocess import PreparedFrame
from bevcli.pipeline.runner import BevState, Runner, StepOptions
from bevcli.pipeline.stage_clock import StageClock


class Version:
    """Steps through frames and keeps the state in between.

    seconds: of each step. centers: (Q, 3) metres, and scores: (Q, classes), of the last step's object queries.
    """

    def __init__(self, model: BEVFormer, device: torch.device) -> None:
        self.runner = Runner(model, device, StepOptions())
        self.runner.clock = StageClock(model, device, *fine_stages(model))
        self.seconds: list[float] = []
        self.centers = self.scores = torch.empty(0)
        self._state: BevState | None = None
        model.register_forward_hook(self._keep)

    def step(self, prepared: PreparedFrame) -> Prediction:
        """One frame, timed until its boxes are there."""
        wait_for(self.runner.device)
        began = time.perf_counter()
        self._state, prediction = self.runner.step(self._state, prepared)
        wait_for(self.runner.device)
        self.seconds.append(time.perf_counter() - began)
        return prediction

    def warm_up(self, prepared: PreparedFrame) -> None:
        """One frame, neither timed nor remembered."""
        self.runner.step(self._state, prepared)

    def forget_times(self) -> None:
        """The steps so far were for warming up."""
        self.seconds = []

    def start_anew(self) -> None:
        """No history and no times."""
        self._state = None
        self.forget_times()

    def _keep(self, _module: nn.Module, _inputs: tuple[object, ...], outputs: BEVFormerOutputs) -> None:
        self.centers = outputs.box_codes[-1, 0][:, [0, 1, 4]]
        self.scores = outputs.class_logits[-1, 0].sigmoid()


def fine_stages(model: BEVFormer) -> tuple[dict[str, str], dict[str, str]]:
    """What a StageClock takes to tell the parts of the encoder apart: stages by module, and before modules."""
    stages = {"backbone": "backbone", "neck": "neck", "decoder": "decoder and head"}
    parts = {
        "temporal_self_attention": "temporal attention",
        "spatial_cross_attention": "spatial attention",
        "feed_forward": "FFN",
    }
    for layer in range(model.config.encoder.layers):
        stages |= {f"encoder.layers.{layer}.{part}": stage for part, stage in parts.items()}
    # The last norm belongs to the last feed-forward network; pillars and history are worked out before the encoder.
    stages |= {"encoder": "FFN", "segmentation_head": "segmentation head"}
    return stages, {"backbone": "input", "encoder": "projection"}
