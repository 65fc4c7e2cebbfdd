"""One version of a model under test, with its history and its times."""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from torch import nn

from bevcli.benchmark.limits import wait_for
from bevcli.benchmark.made_up import MadeUpDrive
from bevcli.engines.exported import ExportedModel
from bevcli.frame import Prediction
from bevcli.model.bevformer import BEVFormerBase, BEVFormerOutputs
from bevcli.pipeline.preprocess import PreparedFrame
from bevcli.pipeline.runner import BevState, Runner, StepOptions
from bevcli.pipeline.stage_clock import StageClock
from bevcli.pipeline.temporal import FeatureWindow


class Version:
    """A version of the model that runs frame after frame.

    Attributes:
        runner: runs the model.
        seconds: of each timed step.
        centers: (Q, 3) metres, bev frame, box centres of the last timed step's object queries.
        scores: (Q, classes) of the same queries.
        state: after the last timed step.
    """

    def __init__(self, model: BEVFormerBase, device: torch.device) -> None:
        self.runner = Runner(model, device, StepOptions())
        self.runner.clock = StageClock(model, device, *fine_stages(model))
        self.seconds: list[float] = []
        self.centers = self.scores = torch.empty(0)
        self.state: BevState | None = None

    def step(self, prepared: PreparedFrame) -> Prediction:
        """Runs and times one frame, from its network inputs to its boxes."""
        with self.runner.model.register_forward_hook(self._keep):
            wait_for(self.runner.device)
            began = time.perf_counter()
            self.state, prediction = self.runner.step(self.state, prepared)
            wait_for(self.runner.device)
            self.seconds.append(time.perf_counter() - began)
        return prediction

    def warm_up(self, prepared: PreparedFrame) -> None:
        """Runs one frame; keeps neither its time nor its BEV map."""
        self.runner.step(self.state, prepared)

    def fill_window(self, drive: MadeUpDrive) -> None:
        """Fills the window of a BEVFormerV2 that has seen one frame, as if it had seen all frames before it too.

        Their image features are copies, which saves the time of those steps.
        """
        if self.state is None or not isinstance(self.state.memory, FeatureWindow) or not self.state.memory.frames:
            return  # nothing of one frame is kept for the next
        seen = self.state.memory.frames[-1]
        earlier = (
            replace(seen, stamp=stamp, pose=drive.pose(stamp.index)) for stamp in drive.stamps[: seen.stamp.index]
        )
        self.state = replace(self.state, memory=FeatureWindow((*earlier, seen)))

    def forget_times(self) -> None:
        """Drops the times so far."""
        self.seconds = []

    def start_anew(self) -> None:
        """Drops the history and the times."""
        self.state = None
        self.forget_times()

    def _keep(self, _module: nn.Module, _inputs: tuple[object, ...], outputs: BEVFormerOutputs) -> None:
        codes = outputs.box_codes[-1, 0]
        self.centers = torch.cat([codes[:, :2], codes[:, 4:5]], dim=-1)
        self.scores = outputs.class_logits[-1, 0].sigmoid()


def fine_stages(model: BEVFormerBase) -> tuple[dict[str, str], dict[str, str]]:
    """The `stages` and `starts` of a StageClock that tells the parts of the encoder apart."""
    if isinstance(model, ExportedModel):
        return {"engine": "engine"}, {"engine": "input"}
    stages = {"backbone": "backbone", "neck": "neck", "decoder": "decoder and head"}
    parts = {
        "temporal_self_attention": "temporal attention",
        "spatial_cross_attention": "spatial attention",
        "feed_forward": "FFN",
    }
    for layer in range(model.config.encoder.layers):
        stages |= {f"encoder.layers.{layer}.{part}": stage for part, stage in parts.items()}
    # The last norm of the encoder counts as FFN; pillars and history are computed just before the encoder.
    stages |= {"encoder": "FFN", "fusion": "fusion", "segmentation_head": "segmentation head"}
    stages |= {"query_interaction": "tracks", "map_head": "map head"}
    return stages, {"backbone": "input", "encoder": "projection"}
