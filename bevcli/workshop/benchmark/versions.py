"""Versions of a model side by side on a made-up drive: plain, prepared, and in other engines."""

import copy
import math
import platform
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from bevcli.config import load_config
from bevcli.errors import BevcliError
from bevcli.frame import CameraImage, Drive, Frame, FrameStamp, Prediction
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import GRAVITY, Kinematics
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.inference import EXPORTED_SUFFIX, TORCH, ModelOptions
from bevcli.inference.load import Model, choose_engine, installed_engines, load_model
from bevcli.inference.machine import keep_freed_memory, return_freed_memory
from bevcli.inference.pipeline import StageClock
from bevcli.inference.runner import Runner, RunnerState
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_attention import DeformableAttention, GridSampling, LevelShapes, sample_maps
from bevcli.model.network import Network, build_network
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import TemporalModel, model_class
from bevcli.parsing.images import encode_image
from bevcli.sequences.images import ImageReader, MessageSource
from bevcli.workshop.engines.engine import CALIBRATION_FRAMES as CALIBRATION_FRAMES
from bevcli.workshop.engines.exported import NEAR_M

WIDTH, HEIGHT = 1600, 900
FOCAL_LENGTH = 1266.0  # pixels, of all nuScenes cameras but the one at the back
BACK_FOCAL_LENGTH = 809.0
STEP_S = 0.5
SPEED = 8.0  # m/s
ENCODED_IMAGES = 12  # JPEG files in memory, which the frames and cameras use in turn

SEED = 0
RESIDUAL_GAIN = 0.25  # of the backbone's blocks, whose initial gain is zero
USUAL_DEVIATION = 57.0  # standard deviation of images, grey levels; other values of `image.std` scale the first layer


class MadeUpDrive(Drive):
    """A drive of any length with moving vehicle and JPEG images.

    The cameras' directions and lenses are those of nuScenes, so that the cameras see as many BEV cells.
    """

    name = "made-up"
    has_ego_motion = True

    def __init__(self, frames: int) -> None:
        self.rig = CameraRig(tuple(map(_camera, NUSCENES_YAWS_DEG)), default_ego_from_bev())
        self.stamps = tuple(FrameStamp(i, "", 10**18 + int(i * STEP_S * 1e9)) for i in range(frames))
        self._files = [_jpeg(seed) for seed in range(ENCODED_IMAGES)]
        self._reader = ImageReader(strict=True)

    def load(self, index: int) -> Frame:
        """The frame at an index; every call decodes its six images, in threads as those of other drives."""
        stamp, pose, first = self.stamps[index], self.pose(index), index * len(self.rig.names)
        decoders = {name: partial(self._image, first + i, stamp) for i, name in enumerate(self.rig.names)}
        sources = {name: MessageSource(name, stamp.timestamp_ns, decode) for name, decode in decoders.items()}
        return Frame(
            stamp=stamp,
            rig=self.rig,
            images=self._reader.read(sources, self.rig, dropped={})[0],
            world_from_ego=pose,
            world_from_ego_at=dict.fromkeys(self.rig.names, pose),
            kinematics=Kinematics(np.array([0, 0, GRAVITY]), np.array([0, 0, 0.05]), np.array([SPEED, 0, 0])),
        )

    def pose(self, index: int) -> Pose:
        """world_from_ego of the frame at an index."""
        seconds = index * STEP_S
        yaw = 0.05 * seconds
        return Pose(np.array([SPEED * seconds, 0.2 * seconds, 0]), np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))

    def _image(self, number: int, stamp: FrameStamp) -> CameraImage:
        encoded = self._files[number % ENCODED_IMAGES]
        pixels = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        return CameraImage(stamp.timestamp_ns, pixels.astype(np.uint8, copy=False), encoded, "image/jpeg")


def made_up_model(config: ModelConfig) -> Network:
    """A model with random weights, the same at every call.

    Weights that are initialised to zero get small random numbers, so that every part affects the result and an error
    in any part shows.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        model = build_network(config).eval()
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                if name.endswith("bn3.weight"):
                    nn.init.constant_(parameter, RESIDUAL_GAIN)
                elif parameter.ndim > 1 and not parameter.any():
                    nn.init.normal_(parameter, std=0.5 / math.sqrt(parameter[0].numel()))
            first = next(module for module in model.backbone.modules() if isinstance(module, nn.Conv2d))
            first.weight *= sum(config.image.std) / 3 / USUAL_DEVIATION
    return model


def _camera(name: str) -> Camera:
    focal_length = BACK_FOCAL_LENGTH if name == "CAM_BACK" else FOCAL_LENGTH
    intrinsics = np.array([[focal_length, 0, WIDTH / 2], [0, focal_length, 0.55 * HEIGHT], [0, 0, 1]])
    looking_forward = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turned = rotation_about_z(np.radians(NUSCENES_YAWS_DEG[name]))
    position = turned @ (0.8, 0, 0) + (0.9, 0, 1.5)
    return Camera(name, WIDTH, HEIGHT, intrinsics, rigid(position, turned @ looking_forward))


def _jpeg(seed: int) -> bytes:
    """Shapes of all sizes and some noise, which take about as many bytes as an image of a street."""
    random = np.random.default_rng(seed)
    layers = [random.normal(0, 60 / (i + 1), (9 * 2**i, 16 * 2**i, 3)).astype(np.float32) for i in range(5)]
    image = 110 + sum(cv2.resize(layer, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for layer in layers)
    return encode_image(np.clip(image, 0, 255).astype(np.uint8), quality=95)


def model_to_time(name: str, options: ModelOptions) -> Model:
    """The exported file of a name, or a model with made-up weights for the engine that is asked for."""
    if name.endswith(EXPORTED_SUFFIX):
        return load_model(name, options=options)
    config = load_config(name)
    engine, device, precision = choose_engine(options, config)
    return Model(made_up_model(config), device, precision, engine=engine)


WARM_UP_FRAMES = 2  # one without and one with history
CPU = torch.device("cpu")
QueryResults = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Comparison:
    """The fast version compared with the plain one, over all object queries of all frames."""

    plain_frame_s: tuple[float, ...]  # seconds of each frame of the plain version
    max_box_difference_m: float  # largest distance between the two versions' box centres
    share_within_tenth_m: float  # share of the box centres that are within 0.1 m of each other
    max_score_difference: float  # largest difference of scores


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
    """One engine in one precision."""

    engine: str  # its name
    precision: str  # of the image features
    seconds: tuple[float, ...] = ()  # of each frame
    largest_m: float = 0.0  # largest distance of a box centre from that of PyTorch in float32, over all object queries
    near: float = 1.0  # share of them that are within 0.1 m, 0 to 1
    score: float = 0.0  # largest difference of scores
    problem: str = ""  # why it could not be measured; "" if it was


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
            loaded = loaded.in_engine(drive.rig, drive)
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


def describe_machine(device: torch.device) -> str:
    """Name of the processor or GPU, number of threads and PyTorch's version."""
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, PyTorch {torch.__version__}"
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text(encoding="utf-8").splitlines() if cpu.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    capability = torch.backends.cpu.get_cpu_capability()
    return f"{name} ({capability}), {torch.get_num_threads()} threads, PyTorch {torch.__version__}"
