"""`load_model`: a configured model with its weights, on a device."""

import copy
import hashlib
import re
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from bevcli.checkpoints import bundled_weights, load_weights, read_checkpoint
from bevcli.config import TRACKING, as_table, known_models, load_config, load_table, settings_of_table
from bevcli.errors import BevcliError, ConfigError, WeightsError
from bevcli.geometry.cameras import CameraRig
from bevcli.inference.options import AUTO, TORCH, ModelOptions
from bevcli.inference.preprocess import image_for_rig
from bevcli.inference.runner import Runner, StepOptions
from bevcli.inference.tracking import TrackerConfig
from bevcli.inference.training_rigs import facts_notes, rig_notes
from bevcli.model.config import ModelConfig
from bevcli.model.prepare import Precision, prepare_for_inference
from bevcli.model.temporal_model import TemporalModel, build_model
from bevcli.options import gather
from bevcli.weights.cache import NamedWeights, all_weights, weights_folder
from bevcli.weights.fetch import by_hand, fetch_weights
from bevcli.workshop.engines.engine_choice import EngineChoice, engine_choice
from bevcli.workshop.engines.exported import SUFFIX, load_exported

DEFAULT_MODEL = "demo"
DEFAULT_ENGINE = "onnxruntime"  # of an exported file
UNTRAINED_SEED = 0  # two untrained runs of one drive agree


@dataclass(frozen=True)
class Model:
    """A model with its weights, and the device that it runs on.

    Attributes:
        network: the plain model, as in its paper, on the CPU; or an exported file.
        device: where it runs.
        precision: of the image features; the rest of the network computes in float32. Only exported files have "int8".
        weights: the file that the weights came from, None for random weights.
        bundled: whether that file is part of the package.
        left_out: what of that file is for training only and was left out; "" for nothing.
        tracker: the parameters of the tracker, the table [tracking] of the model's TOML file.
        not_read: classes and functions in the weights file whose objects were not read.
        engine: the program that computes it: "torch", or for an exported file "onnxruntime" or "openvino".
        facts: metadata in the weights file.
        file: the exported file; None for PyTorch.
        choice: another engine than PyTorch that it is to run in: `in_engine` makes the file when the rig is known.
        engine_note: the differences of that file from PyTorch; "" for other models.
    """

    network: TemporalModel
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    precision: Precision | Literal["int8"] = "fp32"
    weights: Path | None = None
    bundled: bool = False
    left_out: str = ""
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    not_read: tuple[str, ...] = ()
    engine: str = "torch"
    facts: Mapping[str, str] = field(default_factory=dict)
    file: Path | None = None
    choice: EngineChoice | None = None
    engine_note: str = ""

    @property
    def config(self) -> ModelConfig:
        """The model's configuration, as its TOML file states it."""
        return self.network.config

    @property
    def name(self) -> str:
        """The model's name, such as "tiny"."""
        return self.config.name

    @property
    def untrained(self) -> bool:
        """The weights are random: boxes and maps are meaningless."""
        return self.weights is None

    @property
    def is_exported(self) -> bool:
        """The network is an exported file, whose parts cannot be observed, trained or exported again."""
        return self.engine != "torch"

    def require_parts(self, what: str) -> None:
        """Raises BevcliError for an exported file. what: needs the network's parts, such as "`probes`"."""
        if self.choice is not None and self.choice.engine != AUTO:
            raise BevcliError(f"{what}: not available in {self.choice.engine}: use `engine=torch`")
        if self.choice is not None and self.choice.precision == "int8":
            raise BevcliError(f"{what}: not available in INT8, which PyTorch does not have: leave out `precision=int8`")
        if self.is_exported:
            raise BevcliError(f"{what}: not available for {self.file}, an exported file: use {self.name} by its name")

    def contents(self) -> dict[str, Any]:
        """The contents of the model's TOML file, [training] excluded."""
        return as_table(self.config, self.tracker)

    def for_rig(self, rig: CameraRig) -> "Model":
        """The model with images of one size, that of a rig, for an exported file: see `ImageConfig.focal_px`."""
        network = copy.copy(self.network)  # the copy has the same weights
        network.config = replace(self.config, image=image_for_rig(rig, self.config.image))
        return replace(self, network=network)

    def rig_notes(self, rig: CameraRig) -> tuple[str, ...]:
        """Warnings where the rig lies outside the training distribution; none for random weights."""
        if self.untrained:
            return ()
        return (*facts_notes(self.facts, self.config), *rig_notes(rig, self.config))

    @cached_property
    def config_hash(self) -> str:
        """SHA-256 of the configurations of network and tracker."""
        return hashlib.sha256(repr((self.config, self.tracker)).encode()).hexdigest()

    @cached_property
    def weights_hash(self) -> str:
        """SHA-256 of names, types, shapes and values of all weights."""
        return hash_of(self.network.state_dict().items())

    @cached_property
    def prepared(self) -> TemporalModel:
        """The network on its device, made ready for inference on the first use: same results, faster.

        Raises BevcliError for a model that is to run in another engine, before `in_engine`.
        """
        if self.choice is not None:
            raise BevcliError(f"`engine={self.choice.engine}`: needs a drive: pass the model to `bevcli.run`")
        if self.is_exported:
            return self.network
        assert self.precision != "int8"
        return prepare_for_inference(self.network, self.device, self.precision)

    def runner(self, *, track: bool, **asked: Any) -> Runner:
        """Steps the prepared model. track: give boxes identities over time. asked: the other `StepOptions`."""
        return Runner(self.prepared, self.device, StepOptions(tracker=self.tracker if track else None, **asked))


def hash_of(tensors: Iterable[tuple[str, Tensor]]) -> str:
    """SHA-256 of names, types, shapes and numbers, in this order."""
    found = hashlib.sha256()
    for name, tensor in tensors:
        found.update(f"{name}{tensor.dtype}{list(tensor.shape)}".encode())
        found.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def load_model(
    model: str | Path | None = None,
    weights: str | Path | None = None,
    options: ModelOptions | None = None,
    **changes: Any,
) -> Model:
    """Load a model and its weights.

        model = bevcli.load_model("tiny", weights="bevformer_tiny_epoch_24.pth", device="cuda")

    Args:
        model: a known model, one of `bevcli.config.known_models()` such as "tiny" or "demo", a name of the table of
            weights ("tiny-fp16"), a FILE.toml, or an exported FILE.onnx, which holds its weights and runs on the CPU in
            the precision of the file. None takes the model that the weights fit, or "demo" where there are no weights.
        weights: an official .pth as published, or a .safetensors. None takes the weights of the package, which only
            "demo" has, or downloaded ones.
        options: a model with its options; `model` and `weights` replace its own where they are given.
        changes: the other options of `ModelOptions` as keywords: `device` ("auto", "cpu", "cuda", "cuda:1", "mps" or a
            torch.device), `precision`, `untrained`, `engine`, `calibrate_with`, `fetch` (download missing weights) and
            `weights_dir`. In another `engine` than "torch", or in "int8", the model is exported when it first meets a
            rig (`run`, `Session`), which takes up to minutes; the file is kept in the user's cache.

    Raises:
        ConfigError: the model's TOML file is missing or wrong.
        WeightsError: there are no weights, they do not fit or cannot be downloaded, or both weights and `untrained` are
            given.
        BevcliError: the device is not there, the engine is not installed, or an option does not apply to the model.
    """
    given = {name: value for name, value in (("model", model), ("weights", weights)) if value is not None}
    chosen = gather(ModelOptions, options, given | changes)
    return _load_exported(chosen) if str(chosen.model).endswith(SUFFIX) else _load_network(chosen)


def _load_network(options: ModelOptions) -> Model:
    """The model of a TOML file with its weights."""
    name, weights, untrained = options.model, options.weights, options.untrained
    if weights is not None and untrained:
        raise WeightsError(f"`weights={weights}` and `untrained` exclude each other: pass one of them")
    if name is None:
        name = DEFAULT_MODEL if weights is None else _model_of(weights)
    named = all_weights(options.weights_dir).get(str(name))
    config = load_config(name)
    tracker = _tracker(load_table(name, TRACKING, TrackerConfig), config, str(name))
    wanted = weights is None and not untrained
    bundled = bundled_weights(str(name)) if wanted else None
    file = weights or bundled
    if file is None and wanted:
        file = _named_file(config.name, named, options)
    target = choose_device(options.device)
    choice = engine_choice(options, config, target)
    if choice is not None:
        target = torch.device("cpu")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(UNTRAINED_SEED)
        network = build_model(config)
    loaded = None if file is None else load_weights(file, network, str(name))
    return Model(
        network.eval(),
        target,
        "fp32" if choice is not None else choose_precision(options.precision, target),
        file,
        bundled=bundled is not None,
        left_out="" if loaded is None else loaded.left_out,
        tracker=tracker,
        not_read=() if loaded is None else loaded.not_read,
        facts={} if loaded is None else loaded.facts,
        choice=choice,
    )


def _named_file(model: str, named: NamedWeights | None, options: ModelOptions) -> Path:
    """The downloaded weights of a model. Raises WeightsError where there are none."""
    if named is not None and named.file is not None:
        if named.here is not None:
            return named.here
        if options.fetch:
            return fetch_weights(named).path
        how = f"run {_fetch_command(named.name, options)}, which downloads them"
    elif named is not None:
        how = f"they {by_hand(named)}"
    else:
        how = "pass `weights=FILE` (the official .pth or a .safetensors)"
    raise WeightsError(
        f"model {model} has no weights: {how}, or pass `untrained=True` to try the program with random weights"
    )


def _fetch_command(name: str, options: ModelOptions) -> str:
    if options.weights_dir in (None, weights_folder().absolute()):
        return f"`bevcli weights fetch {name}`"
    return f"`bevcli weights fetch {name} --weights-dir {shlex.quote(str(options.weights_dir))}`"


def _tracker(stated: TrackerConfig, config: ModelConfig, file: str) -> TrackerConfig:
    """The tracker's parameters for the classes of a model. Raises ConfigError."""
    try:
        return stated.for_classes(config.object_classes)
    except ValueError as error:
        raise ConfigError(f"{file}: [{TRACKING}]: {error}") from None


def _load_exported(options: ModelOptions) -> Model:
    """The model of a file of `bevcli export-onnx` or `bevcli quantize`."""
    file, engine = Path(str(options.model)), DEFAULT_ENGINE if options.engine in (None, AUTO) else options.engine
    if engine == TORCH:
        raise BevcliError(f"`engine=torch`: {file} is an exported file: use its model by its name")
    if options.weights is not None or options.untrained:
        option = "`untrained`" if options.untrained else f"`weights={options.weights}`"
        raise WeightsError(f"{file}: an exported file holds its weights: leave out {option}")
    if options.precision is not None:
        raise BevcliError(
            f"`precision={options.precision}`: {file} has a fixed precision: leave out the option "
            "(bevcli quantize writes files with INT8)"
        )
    if str(options.device) not in ("auto", "cpu"):
        raise BevcliError(f"`device={options.device}`: {file} runs on the CPU: leave out the option")
    network = load_exported(file, engine)
    found = network.metadata
    stated = settings_of_table(found.contents, TRACKING, TrackerConfig, str(file))
    return Model(
        network,
        torch.device("cpu"),
        found.precision,
        None if found.untrained else file,
        bundled=found.bundled,
        tracker=_tracker(stated, found.config, str(file)),
        engine=engine,
        file=file,
    )


def _model_of(weights: Path) -> str:
    """The first known model that a file of weights fits."""
    models = read_checkpoint(weights).models
    if not models:
        raise WeightsError(
            f"{weights}: fits none of the known models ({', '.join(known_models())}): name its own by `model=FILE.toml`"
        )
    return models[0]


def choose_device(name: str | torch.device) -> torch.device:
    """The device of a name: "auto" (a CUDA GPU where there is one), "cpu", "cuda", "cuda:N" or "mps".

    Raises BevcliError if the name is unknown or there is no such device.
    """
    if isinstance(name, torch.device):
        return name
    numbered = re.fullmatch(r"cuda:(\d+)", name)
    if name not in ("auto", "cpu", "cuda", "mps") and not numbered:
        raise BevcliError(f'`device={name}`: unknown device (expected "auto", "cpu", "cuda", "cuda:N" or "mps")')
    if name == "mps" and not torch.backends.mps.is_available():
        raise BevcliError("`device=mps`: PyTorch sees no Apple GPU here (use `device=cpu`)")
    available = torch.cuda.is_available()
    if name.startswith("cuda") and not available:
        raise BevcliError(
            f"`device={name}`: PyTorch sees no CUDA GPU here (use `device=cpu`, or install a CUDA build of torch)"
        )
    if numbered and int(numbered[1]) >= (count := torch.cuda.device_count()):
        raise BevcliError(f"`device={name}`: there is no such GPU (found {count}: cuda:0 to cuda:{count - 1})")
    if name == "auto":
        name = "cuda" if available else "cpu"
    return torch.device(name)


def choose_precision(chosen: Precision | Literal["int8"] | None, device: torch.device) -> Precision:
    """The chosen precision of PyTorch, or by default fp32 on the CPU and bf16 on a GPU."""
    assert chosen != "int8"
    return chosen or ("bf16" if device.type == "cuda" else "fp32")
