"""`load_model`: a configured model with its weights, on a device."""

import hashlib
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.checkpoints import bundled_weights, load_weights, read_checkpoint
from bevcli.config import TRACKING, as_table, config_of_table, known_models, read_model_file, settings_of_table
from bevcli.errors import BevcliError, ConfigError, InputError, WeightsError
from bevcli.frame import ColorOrder, Drive, Frame, FrameStamp, Prediction, check_color_order
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose
from bevcli.inference import (
    EXPORTED_SUFFIX,
    FILE_ENGINE,
    PHOTOGRAPHS,
    RENDERED,
    TORCH,
    ModelOptions,
    StepOptions,
)
from bevcli.inference.preprocess import checked_images
from bevcli.inference.runner import Runner
from bevcli.inference.tracking import TrackerConfig
from bevcli.model import AnyPrecision
from bevcli.model.config import ModelConfig, facts_notes, training_rig_notes
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.temporal_model import TemporalModel, build_model
from bevcli.options import gather
from bevcli.published import NamedWeights, all_weights, hub_model, named_weights
from bevcli.registry import entries, is_of_hub, load
from bevcli.sequences.files.calibration_file import CALIBRATION, draft_calibration, read_calibration
from bevcli.sequences.images import AT_REST
from bevcli.writing import weights_folder

WEIGHTS_SUFFIXES = (".pth", ".pt", ".ckpt", ".safetensors")
UNTRAINED_SEED = 0  # two untrained runs of one drive agree


@dataclass(frozen=True)
class Model:
    """A model with its weights, and the device that it runs on.

    Attributes:
        network: the plain model, as in its paper, on the CPU; or an exported file.
        device: where it runs.
        precision: of the image features; the rest of the network computes in float32. Only other engines have "int8".
        weights: the file that the weights came from, None for random weights.
        bundled: whether that file is part of the package.
        left_out: what of that file is for training only and was left out; "" for nothing.
        tracker: the parameters of the tracker, the table [tracking] of the model's TOML file.
        not_read: classes and functions in the weights file whose objects were not read.
        engine: the program that computes it: "torch", or the name of another engine, such as "openvino".
        facts: metadata in the weights file.
        file: the exported file that another engine runs; None for PyTorch, and before `in_engine` has made it.
        calibrate_with: drive whose first frames calibrate INT8; None for the drive that is run.
        engine_note: engine, precision and file of an exported model; "" for other models.
        source: name and revision of a model of a hub; "" for other models.
    """

    network: TemporalModel
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    precision: AnyPrecision = "fp32"
    weights: Path | None = None
    bundled: bool = False
    left_out: str = ""
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    not_read: tuple[str, ...] = ()
    engine: str = TORCH
    facts: Mapping[str, str] = field(default_factory=dict)
    file: Path | None = None
    calibrate_with: Path | None = None
    engine_note: str = ""
    source: str = ""

    def __repr__(self) -> str:
        source = self.weights or self.file
        weights = "random weights" if source is None else source.name
        return f"Model({self.name}, {weights}, {self.precision} on {self.device} by {self.engine})"

    def __call__(
        self,
        images: Mapping[str, NDArray[Any]],
        calibration: CameraRig | str | Path | None = None,
        *,
        color_order: ColorOrder = "bgr",
    ) -> Prediction:
        """The prediction for one frame alone, without history, times and poses: the vehicle is taken to stand.

            prediction = model({"CAM_FRONT": image}, "calibration.json")

        A `Session` steps the model over frames in order, and gives better boxes: it uses the history.

        Args:
            images: camera -> (H, W, 3) uint8, in the size that the calibration states; cameras may be missing.
            calibration: the cameras: a `CameraRig`, such as `drive.rig`, or a calibration file.
            color_order: of the images: "bgr", as OpenCV decodes them, or "rgb".

        Raises InputError without a calibration, for an unknown camera or color order, and for an image of another size
        or type.
        """
        check_color_order(color_order)
        if not isinstance(calibration, CameraRig | str | Path):
            found = "is missing" if calibration is None else f"is a {type(calibration).__name__}"
            raise InputError(
                f"`calibration` {found}: model {self.name} does not know where your cameras are: "
                "pass a calibration.json, or a CameraRig such as `drive.rig`"
            )
        rig = calibration if isinstance(calibration, CameraRig) else read_calibration(Path(calibration))
        given, pose = checked_images(images, rig, color_order, 0), Pose.identity()
        dropped = {name: "not given" for name in rig.names if name not in given}
        at = dict.fromkeys(rig.names, pose)
        frame = Frame(FrameStamp(0, "", 0), rig, given, pose, at, AT_REST, dropped)
        runner = self.in_engine(rig).runner(StepOptions(track=False))
        return runner.step(None, runner.prepare(frame))[1]

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
        return self.file is not None

    @property
    def needs_export(self) -> bool:
        """The model is to run in another engine, and `in_engine` has not made its file yet."""
        return self.engine != TORCH and not self.is_exported

    def require_parts(self, what: str) -> None:
        """Raises BevcliError for another engine than PyTorch. what: needs the network's parts, such as "`probes`"."""
        if self.needs_export:
            int8, engine = "`precision=int8` (`--precision int8`)", f"`engine={self.engine}` (`--engine`)"
            given = int8 if self.precision == "int8" else engine
            raise BevcliError(f"{what}: not available in {self.engine}, but in PyTorch: leave out {given}")
        if self.is_exported:
            raise BevcliError(f"{what}: not available for {self.file}, an exported file: use {self.name} by its name")

    def contents(self) -> dict[str, Any]:
        """The contents of the model's TOML file, [training] excluded."""
        return as_table(self.config, self.tracker)

    def training_notes(self, rig: CameraRig) -> tuple[str, ...]:
        """Warnings where the rig or the model's file differs from the training; none for random weights."""
        if self.untrained:
            return ()
        return (*facts_notes(self.facts, self.config), *training_rig_notes(rig, self.config))

    @cached_property
    def config_hash(self) -> str:
        """SHA-256 of the configurations of network and tracker."""
        return hashlib.sha256(repr((self.config, self.tracker)).encode()).hexdigest()

    @cached_property
    def weights_hash(self) -> str:
        """SHA-256 of names, types, shapes and values of all weights."""
        return hash_of(self.network.state_dict().items())

    def in_engine(self, rig: CameraRig, drive: Drive | None = None, *, parts: str = "") -> "Model":
        """The model in the engine that it was loaded for; one in PyTorch or an exported one is returned as it is.

        The first call exports the model for the number of cameras and the image size of the rig, and calibrates INT8 on
        the first frames of a drive, and tells so in the log: it takes time. The file is kept in the user's cache.

        Args:
            rig: that it is to run on.
            drive: whose first frames calibrate INT8; None where there are no frames yet.
            parts: what looks into the network, such as "`probes`", which only PyTorch has.

        Raises:
            BevcliError: `parts` are asked for in another engine, or the engine is not installed.
            InputError: there are no frames to calibrate with, or a frame cannot be read.
            OutputError: the cache cannot be written.
        """
        if parts:
            self.require_parts(parts)
        if not self.needs_export:
            return self
        exported: Model = load("bevcli.engines", self.engine).export(self, rig, drive)
        return exported

    @cached_property
    def prepared(self) -> TemporalModel:
        """The network on its device, made ready for inference on the first use: same results, faster.

        Raises BevcliError for a model that is to run in another engine, before `in_engine`.
        """
        if self.needs_export:
            raise BevcliError(f"`engine={self.engine}` (`--engine`): needs a drive: pass the model to `bevcli.run`")
        if self.is_exported:
            return self.network
        assert self.precision != "int8"
        return prepare_for_inference(self.network, self.device, self.precision)

    def runner(self, options: StepOptions) -> Runner:
        """Steps the prepared model. Raises InputError, see `Runner`."""
        network, device, pixels = self.prepared, self.device, self.is_exported
        return Runner(network, device, options, tracker=self.tracker, pixels=pixels, untrained=self.untrained)


def hash_of(tensors: Iterable[tuple[str, Tensor]]) -> str:
    """SHA-256 of names, types, shapes and numbers, in this order."""
    digest = hashlib.sha256()
    for name, tensor in tensors:
        digest.update(f"{name}{tensor.dtype}{list(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


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
            weights ("tiny-fp16"), a FILE.toml, a model of the Hugging Face Hub ("hf:OWNER/NAME" or
            "hf:OWNER/NAME@REVISION"), or an exported FILE.onnx, which holds its weights and runs on the CPU in the
            precision of the file. None takes the model that the weights fit, or "photographs" where there are no
            weights; `bevcli run` takes "demo" where the drive is a rendering of bevcli.
        weights: an official .pth as published, or a .safetensors. None takes the weights of the package, which
            "demo" and "photographs" have, or downloaded ones.
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
    if str(chosen.model).endswith(EXPORTED_SUFFIX):
        if chosen.engine == TORCH:
            raise BevcliError(
                f"`engine=torch` (`--engine torch`): {chosen.model} is an exported file: use its model by its name"
            )
        engine = chosen.engine or FILE_ENGINE
        opened: Model = _engine(engine).open_model(engine, chosen)
        return opened
    if chosen.weights is not None and chosen.untrained:
        raise WeightsError(
            f"`weights={chosen.weights}` (`--weights`) and `untrained` (`--untrained`) exclude each other: pass one of "
            "them"
        )
    if Path(str(chosen.model)).suffix in WEIGHTS_SUFFIXES:
        raise WeightsError(
            f"`model={chosen.model}` (`--model`): is a file of weights: pass it as `weights={chosen.model}` "
            f"(`--weights {chosen.model}`)"
        )
    name = str(chosen.model or (PHOTOGRAPHS if chosen.weights is None else _model_of(chosen.weights)))
    of_hub = None
    if is_of_hub(name):  # here, because `fetch` looks for a newer version
        of_hub = hub_model(name, fetch=chosen.fetch)
    contents, file = read_model_file(name)
    config = config_of_table(contents, file)
    tracker = tracker_of_table(contents, config, file)
    path, bundled = chosen.weights, None if chosen.weights or chosen.untrained else bundled_weights(name)
    if path is None and not chosen.untrained:
        untrained = ", or pass `untrained=True` (`--untrained`) to try the program with random weights"
        path = bundled or (of_hub.weights if of_hub else _published(name, chosen, untrained))
    engine, device, precision = choose_engine(chosen, config)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(UNTRAINED_SEED)
        network = build_model(config)
    loaded = None if path is None else load_weights(path, network, name)
    return Model(
        network.eval(),
        device,
        precision,
        path,
        bundled=bundled is not None,
        left_out="" if loaded is None else loaded.left_out,
        tracker=tracker,
        not_read=() if loaded is None else loaded.not_read,
        engine=engine,
        facts={} if loaded is None else loaded.facts,
        calibrate_with=chosen.calibrate_with,
        source=of_hub.source if of_hub else "",
    )


def default_model(drives: Iterable[str | Path]) -> str:
    """The model of the package for drives: "demo" if the calibration.json of each states that bevcli rendered it.

    Otherwise "photographs", also for other formats, videos, URLs, a calibration that cannot be read, and no drive.
    """
    stated = [_is_rendered(Path(drive)) for drive in drives]
    return RENDERED if stated and all(stated) else PHOTOGRAPHS


def _is_rendered(drive: Path) -> bool:
    try:
        return draft_calibration(drive / CALIBRATION).facts.rendered
    except (BevcliError, OSError):
        return False


def choose_model(options: ModelOptions, drives: Sequence[str | Path] | None) -> tuple[ModelOptions, tuple[str, ...]]:
    """The options with `default_model` where they name neither a model nor weights, and a note if it is "photographs".

    drives: paths and URLs of those that the model is to run on; None for rendered ones that are known by their seeds.
    """
    if options.model is not None or options.weights is not None:
        return options, ()
    name = RENDERED if drives is None else default_model(drives)
    chosen = replace(options, model=name)
    if name == RENDERED or not drives:
        return chosen, ()
    which = "the drive is no rendering" if len(drives) == 1 else "not all drives are renderings"
    return chosen, (f"model {name}, as {which} of bevcli: `model` (`--model`) chooses another",)


def weights_file(path_or_name: Path) -> Path:
    """The file at a path, or the weights of a name on this machine. Raises WeightsError for a name without a file."""
    name = str(path_or_name)
    if is_of_hub(name):
        return hub_model(name).weights
    if path_or_name.suffix or path_or_name.is_file():
        return path_or_name
    if name not in known_models():
        named_weights(name)  # raises WeightsError that lists the names
    return bundled_weights(name) or _published(name, ModelOptions())


def weights_to_fetch(options: ModelOptions) -> NamedWeights | None:
    """The weights that `load_model` would download; None where there are none."""
    name = str(options.model or PHOTOGRAPHS)
    if not options.fetch or options.weights or options.untrained or bundled_weights(name):
        return None
    named = all_weights(options.weights_dir).get(name)
    return named if named is not None and named.source.url and named.here is None else None


def _published(name: str, options: ModelOptions, otherwise: str = "") -> Path:
    """The published weights of a name: downloaded ones, or with `fetch` ones that are downloaded now.

    otherwise: ends the message of the WeightsError where there are none.
    """
    named = all_weights(options.weights_dir).get(name)
    if named is not None and named.here is not None:
        return named.here
    if named is None:
        how = "pass `weights` (`--weights FILE`), the official .pth or a .safetensors"
    elif named.file is None:
        how = f"they {named.by_hand}"
    elif options.fetch:
        from bevcli.workshop.weights.fetch import fetch_weights

        return fetch_weights(named).path
    elif options.weights_dir in (None, weights_folder().absolute()):
        how = f"run `bevcli weights fetch {name}`, which downloads them"
    else:
        folder = shlex.quote(str(options.weights_dir))
        how = f"run `bevcli weights fetch {name} --weights-dir {folder}`, which downloads them"
    raise WeightsError(f"model {name} has no weights: {how}{otherwise}")


def tracker_of_table(contents: dict[str, Any], config: ModelConfig, file: str) -> TrackerConfig:
    """The tracker's parameters in the contents of a model's file, for its classes. Raises ConfigError."""
    stated = settings_of_table(contents, TRACKING, TrackerConfig, file)
    try:
        return stated.for_classes(config.object_classes)
    except ValueError as error:
        raise ConfigError(f"{file}: [{TRACKING}]: {error}") from None


def choose_engine(options: ModelOptions, config: ModelConfig) -> tuple[str, torch.device, AnyPrecision]:
    """The engine, device and precision that the options ask for; by default PyTorch, or for INT8 one that has it.

    The default precision of PyTorch is fp32 on the CPU and bf16 on a GPU.

    Raises BevcliError for what is not there, does not fit the model, or excludes each other.
    """
    engine, device, is_int8 = options.engine, choose_device(options.device), options.precision == "int8"
    if options.calibrate_with is not None and not is_int8:
        raise BevcliError("`calibrate_with` (`--int8-drive`): is for `precision=int8` (`--precision int8`)")
    if is_int8 and engine == TORCH:
        raise BevcliError(
            "`precision=int8` (`--precision int8`): PyTorch has no INT8 here: choose another `engine` (`--engine`), "
            "or leave it out"
        )
    if is_int8 and engine is None:
        engine = next(iter(installed_engines()), None)
        if engine is None:
            raise BevcliError(
                "`precision=int8` (`--precision int8`): no engine is installed: run pip install 'bevcli[openvino]'"
            )
    if engine in (None, TORCH):
        assert options.precision != "int8"
        return TORCH, device, options.precision or ("bf16" if device.type == "cuda" else "fp32")
    _engine(engine).check_options(engine, options, config)
    return engine, torch.device("cpu"), options.precision or "fp32"


def _engine(name: str) -> Any:
    """The class of another engine than PyTorch, see `bevcli.workshop.engines.engine.Engine`. Raises BevcliError."""
    engines = list(entries("bevcli.engines"))
    if name not in engines:
        raise BevcliError(f"`engine={name}` (`--engine`): unknown engine (expected {', '.join((TORCH, *engines))})")
    return load("bevcli.engines", name)


def installed_engines() -> dict[str, Any]:
    """The engines whose packages are installed, the one with the lowest rank first."""
    engines = {}
    for name in entries("bevcli.engines"):
        with suppress(BevcliError):  # not installed, or a broken package of somebody else
            engine = load("bevcli.engines", name)
            engine.require_packages()
            engines[name] = engine
    return dict(sorted(engines.items(), key=lambda item: item[1].rank))


def _model_of(weights: Path) -> str:
    """The first known model that a file of weights fits."""
    checkpoint = read_checkpoint(weights)
    if not checkpoint.models:
        raise WeightsError(f"{weights}: {checkpoint.misfit}")
    return checkpoint.models[0]


def choose_device(name: str | torch.device) -> torch.device:
    """The device of a name: "auto" (a CUDA GPU where there is one), "cpu", "cuda", "cuda:N" or "mps".

    Raises BevcliError if the name is unknown or there is no such device.
    """
    if isinstance(name, torch.device):
        return name
    numbered = re.fullmatch(r"cuda:(\d+)", name)
    if name not in ("auto", "cpu", "cuda", "mps") and not numbered:
        raise BevcliError(
            f'`device={name}` (`--device`): unknown device (expected "auto", "cpu", "cuda", "cuda:N" or "mps")'
        )
    if name == "mps" and not torch.backends.mps.is_available():
        raise BevcliError(
            "`device=mps` (`--device mps`): PyTorch sees no Apple GPU here (use `device=cpu` (`--device cpu`))"
        )
    available = torch.cuda.is_available()
    if name.startswith("cuda") and not available:
        raise BevcliError(
            f"`device={name}` (`--device`): PyTorch sees no CUDA GPU here (use `device=cpu` (`--device cpu`), or "
            "install a CUDA build of torch)"
        )
    if numbered and int(numbered[1]) >= (count := torch.cuda.device_count()):
        raise BevcliError(
            f"`device={name}` (`--device`): there is no such GPU (found {count}: cuda:0 to cuda:{count - 1})"
        )
    if name == "auto":
        name = "cuda" if available else "cpu"
    return torch.device(name)
