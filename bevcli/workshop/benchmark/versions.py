"""Versions of a model side by side: the plain one, the prepared one, and the same model in other engines."""

import copy
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import torch
from torch import Tensor, nn

from bevcli.config import load_config
from bevcli.errors import BevcliError
from bevcli.frame import Prediction
from bevcli.inference.load import Model, describe_machine, installed_engines
from bevcli.inference.machine import keep_freed_memory, return_freed_memory
from bevcli.inference.options import TORCH
from bevcli.inference.pipeline import StageClock
from bevcli.inference.runner import Runner, RunnerState
from bevcli.model.deformable_attention import DeformableAttention, GridSampling, LevelShapes, sample_maps
from bevcli.model.network import Network
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import TemporalModel, model_class
from bevcli.printing import print_note
from bevcli.workshop.benchmark.made_up import MadeUpDrive, made_up_model
from bevcli.workshop.engines.engine import CALIBRATION_FRAMES
from bevcli.workshop.engines.exported import NEAR_M

WARM_UP_FRAMES = 2  # one without and one with history
CPU = torch.device("cpu")
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
        self.runner = Runner(model, device, pixels=takes_pixels)
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
        model = model_class(self.runner.config)  # an exported file has the memory of its model
        self.state = replace(self.state, memory=model.with_past(self.runner.model, self.state.memory, past))

    def _keep(self, _module: nn.Module, _inputs: tuple[object, ...], outputs: ModelOutputs) -> None:
        codes = outputs.box_codes[-1, 0]
        self.queries = torch.cat([codes[:, :2], codes[:, 4:5]], dim=-1), outputs.class_logits[-1, 0].sigmoid()


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
    modules = {
        "temporal_self_attention": "temporal attention",
        "spatial_cross_attention": "spatial attention",
        "feed_forward": "FFN",
    }
    for layer in range(model.config.encoder.layers):
        stages |= {f"encoder.layers.{layer}.{module}": stage for module, stage in modules.items()}
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


@dataclass(frozen=True)
class EngineRow:
    """One engine in one precision.

    Attributes:
        engine: its name.
        precision: of the image features.
        seconds: of each frame.
        largest_m: largest distance of a box centre from that of PyTorch in float32, over all object queries.
        near: share of them that are within 0.1 m, 0 to 1.
        score: largest difference of scores.
        problem: why it could not be measured; "" if it was.
    """

    engine: str
    precision: str
    seconds: tuple[float, ...] = ()
    largest_m: float = 0.0
    near: float = 1.0
    score: float = 0.0
    problem: str = ""


@dataclass(frozen=True)
class EngineTable:
    """All engines of a model on this machine. rows: PyTorch in float32 is the first one."""

    model: str
    machine: str
    rows: tuple[EngineRow, ...]

    def as_data(self) -> dict[str, Any]:
        """The table for JSON."""
        return {"model": self.model, "machine": self.machine, "engines": [vars(row) for row in self.rows]}

    def text(self) -> str:
        """The table."""
        first = median(self.rows[0].seconds)
        heads = ("engine", "frame, ms", "fastest to slowest", "of torch fp32", "in 0.1 m", "largest, m", "scores")
        lines = [f"{self.model}, {self.machine}, alternating frames, made-up weights", "", _line(*heads)]
        for row in self.rows:
            name = f"{row.engine} {row.precision}"
            if row.problem:
                lines.append(f"{name:<18}{row.problem}")
                continue
            middle, span = median(row.seconds), f"{1000 * min(row.seconds):.1f} to {1000 * max(row.seconds):.1f}"
            cells = (f"{1000 * middle:.1f}", span, f"{middle / first:.2f}", f"{row.near:.1%}")
            lines.append(_line(name, *cells, f"{row.largest_m:.2g}", f"{row.score:.2g}"))
        return "\n".join(lines)


def compare_engines(model: str, frames: int) -> EngineTable:
    """Time a step of PyTorch and of every installed engine on the same frames, in turn, and compare their boxes.

    Nothing else should run on the machine.

    Args:
        model: its name or file; it gets made-up weights.
        frames: number of timed frames.
    """
    config = load_config(model)
    versions: dict[tuple[str, Any], Version] = {}
    failed: list[EngineRow] = []
    network, drive = made_up_model(config), MadeUpDrive(CALIBRATION_FRAMES)
    kinds: dict[str, Any] = {name: engine_class.precisions for name, engine_class in installed_engines().items()}
    pairs = (
        (engine, precision)
        for engine, precisions in ({TORCH: ("fp32", "bf16")} | kinds).items()
        for precision in precisions
    )
    for engine, precision in pairs:
        loaded = Model(network, engine=engine, precision=precision)
        try:
            loaded = loaded.in_engine(drive.rig, drive, report=print_note)
        except BevcliError as error:
            failed.append(EngineRow(engine, precision, problem=str(error)))
        else:
            versions[engine, precision] = Version(loaded.prepared, CPU, takes_pixels=loaded.is_exported)
    first = config.past_frames
    drive = MadeUpDrive(first + WARM_UP_FRAMES + frames)
    differences: dict[tuple[str, Any], list[tuple[Tensor, Tensor]]] = {name: [] for name in versions}
    for index in range(first, len(drive.stamps)):
        frame = drive.load(index)
        for name, version in versions.items():
            version.step(version.runner.preprocess(frame))
            if index == first:
                version.fill_past(drive)
            if index >= first + WARM_UP_FRAMES:
                differences[name].append(difference(version.queries, versions[TORCH, "fp32"].queries))
    rows = [
        EngineRow(*name, tuple(version.seconds[WARM_UP_FRAMES:]), *largest_differences(differences[name]))
        for name, version in versions.items()
    ]
    return EngineTable(config.name, describe_machine(CPU), (*rows, *failed))


def _line(name: str, *cells: str) -> str:
    return f"{name:<18}" + "".join(f"{cell:>20}" if "to" in cell.split() else f"{cell:>14}" for cell in cells)
