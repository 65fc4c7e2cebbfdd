"""Versions of a model: the plain one as a yardstick of speed and results, and the prepared one, compared with it."""

import copy
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from bevcli.frame import FrameStamp, Prediction
from bevcli.geometry.transforms import Pose
from bevcli.inference.machine import keep_freed_memory, return_freed_memory
from bevcli.inference.pipeline import StageClock
from bevcli.inference.runner import Runner, RunnerState, StepOptions
from bevcli.model.bevformer_v2.bevformer_v2 import FeatureWindow
from bevcli.model.deformable_attention import DeformableAttention, GridSampling, LevelShapes, sample_maps
from bevcli.model.network import Network
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import TemporalModel, model_class
from bevcli.registry import for_model
from bevcli.workshop.benchmark.made_up import MadeUpDrive
from bevcli.workshop.engines.differences import NEAR_M

QueryResults = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Comparison:
    """The fast version compared with the plain one, over all object queries of all frames.

    Attributes:
        plain_frame_s: seconds of each frame of the plain version.
        max_box_difference_m: largest distance between the two versions' box centres.
        share_within_tenth_m: share of the box centres that are within 0.1 m of each other.
        max_score_difference: largest difference of scores.
    """

    plain_frame_s: tuple[float, ...]
    max_box_difference_m: float
    share_within_tenth_m: float
    max_score_difference: float


class Version:
    """A version of the model that runs frame after frame.

    Attributes:
        runner: runs the model.
        seconds: of each timed step.
        queries: of the last timed step: centres (Q, 3) of the boxes, metres, bev frame; scores (Q, classes).
        state: after the last timed step.
    """

    def __init__(self, model: TemporalModel, device: torch.device, *, takes_pixels: bool = False) -> None:
        self.runner = Runner(model, device, StepOptions(takes_pixels=takes_pixels))
        self.runner.clock = StageClock(model, device, *fine_stages(model))
        self.seconds: list[float] = []
        self.queries: QueryResults = (torch.empty(0), torch.empty(0))
        self.state: RunnerState[Any] | None = None

    def step(self, prepared: PreparedFrame) -> Prediction:
        """Runs and times one frame, from its network inputs to its boxes."""
        with self.runner.model.register_forward_hook(self._keep):
            wait_for(self.runner.device)
            began = time.perf_counter()
            self.state, prediction = self.runner.step(self.state, prepared)
            wait_for(self.runner.device)
            self.seconds.append(time.perf_counter() - began)
        return prediction

    def fill_past(self, drive: MadeUpDrive) -> None:
        """Make a model that has seen one frame go on as if it had seen all frames before it too."""
        assert self.state is not None
        assert self.state.stamp is not None
        past = [(stamp, drive.pose(stamp.index)) for stamp in drive.stamps[: self.state.stamp.index]]
        for with_past in for_model("past", model_class(self.runner.config))[:1]:
            self.state = replace(self.state, memory=with_past(self.state.memory, past))

    def _keep(self, _module: nn.Module, _inputs: tuple[object, ...], outputs: ModelOutputs) -> None:
        codes = outputs.box_codes[-1, 0]
        self.queries = torch.cat([codes[:, :2], codes[:, 4:5]], dim=-1), outputs.class_logits[-1, 0].sigmoid()


def with_past(memory: FeatureWindow, past: Sequence[tuple[FrameStamp, Pose]]) -> FeatureWindow:
    """A memory as if the model had seen earlier frames too, with copies of the image features.

    past: their stamps and world_from_ego.
    """
    if not memory.frames:
        return memory  # nothing of one frame is kept for the next
    seen = memory.frames[-1]
    return FeatureWindow((*(replace(seen, stamp=stamp, pose=pose) for stamp, pose in past), seen))


def wait_for(device: torch.device) -> None:
    """Returns when a GPU has finished all queued work; at once on a CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    if device.type == "mps":
        torch.mps.synchronize()


def fine_stages(model: TemporalModel) -> tuple[dict[str, str], dict[str, str]]:
    """The `stages` and `starts` of a StageClock that tells the parts of the encoder apart."""
    stages = {module: stage.replace("_", " ") for module, stage in model.stages.items()}
    if "" in stages:  # of the whole model, a CUDA graph
        return stages, {}
    if not isinstance(model, Network):
        return stages, dict.fromkeys(stages, "input")
    parts = {
        "temporal_self_attention": "temporal attention",
        "spatial_cross_attention": "spatial attention",
        "feed_forward": "FFN",
    }
    for layer in range(model.config.encoder.layers):
        stages |= {f"encoder.layers.{layer}.{part}": stage for part, stage in parts.items()}
    # The last norm of the encoder counts as FFN; the history is turned just before the encoder. Pillars
    # are input.
    stages |= {"encoder": "FFN", "decoder": "decoder and head"}
    return stages, {"backbone": "input", "encoder": "projection"}


def textbook_version(model: Network, device: torch.device) -> Network:
    """A copy of the plain model on a device that samples as the released code does.

    Separate batch norms, channels-first float32, `grid_sample` with each camera's queries padded to the longest list.
    """
    textbook = copy.deepcopy(model).to(device).eval().requires_grad_(False)
    for module in textbook.modules():
        if isinstance(module, DeformableAttention):
            module.sampling = PaddedSampling()
    return textbook


class PaddedSampling(GridSampling):
    """`grid_sample` of all maps at once; the queries of every map are padded to the longest list."""

    def forward(
        self,
        values: Tensor,
        level_shapes: LevelShapes,
        locations: Tensor,
        weights: Tensor,
        queries_per_map: Sequence[int],
    ) -> Tensor:
        """Arguments and result as for `GridSampling`."""
        counts = torch.tensor(queries_per_map, device=values.device)
        longest = max(queries_per_map)
        is_query = torch.arange(longest, device=values.device) < counts[:, None]  # (G, longest)
        padded_locations = locations.new_zeros(len(counts), longest, *locations.shape[1:])
        padded_weights = weights.new_zeros(len(counts), longest, *weights.shape[1:])
        padded_locations[is_query], padded_weights[is_query] = locations, weights
        return sample_maps(values, level_shapes, padded_locations, padded_weights)[is_query]


def compare_with_plain(
    model: Network, fast: Version, frames: Iterable[PreparedFrame]
) -> tuple[Comparison, tuple[float, ...]]:
    """Runs both versions on each frame in turn, each with its own history.

    On a CPU the plain version runs with the C library's default memory settings, as any PyTorch model would. Keeping
    freed memory is part of the fast version. It therefore runs one step untimed before each timed one.

    model: the plain model. fast: its prepared version. Returns the comparison, and the seconds of the fast version.
    """
    device = fast.runner.device
    plain = Version(textbook_version(model, device), device)
    fast.state, fast.seconds = None, []
    differences = []
    for prepared in frames:
        if device.type == "cpu":
            return_freed_memory()
        plain.step(prepared)
        if device.type == "cpu":
            keep_freed_memory()
        fast.runner.step(fast.state, prepared)  # to have memory to reuse
        fast.step(prepared)
        differences.append(difference(fast.queries, plain.queries))
    return Comparison(tuple(plain.seconds), *largest_differences(differences)), tuple(fast.seconds)


def difference(ours: QueryResults, theirs: QueryResults) -> tuple[Tensor, Tensor]:
    """Distances (Q,) of the box centres, metres, and the largest difference of scores, on the CPU."""
    (centers, scores), (other_centers, other_scores) = ours, theirs
    distances = (centers.float().cpu() - other_centers.float().cpu()).norm(dim=-1)
    return distances, (scores.float().cpu() - other_scores.float().cpu()).abs().max()


def largest_differences(frames: Sequence[tuple[Tensor, Tensor]]) -> tuple[float, float, float]:
    """Largest distance of box centres, share of them within NEAR_M, and largest difference of scores of some frames."""
    distances, scores = torch.cat([metres for metres, _ in frames]), torch.stack([score for _, score in frames])
    return float(distances.max()), float((distances <= NEAR_M).float().mean()), float(scores.max())  # NaN is not near
