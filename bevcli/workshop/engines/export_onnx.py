"""`export_onnx` writes one step of a model as an ONNX file, `quantize` a copy of it that computes in INT8.

The quantisation is ONNX Runtime's static one after training: weights in 8 bits, one scale for each output channel;
activations in 8 bits, one scale a tensor, from the smallest and the largest value of the calibration images. Everything
after the neck stays in float32: it is a small part of the work, and rounding it would move boxes.
"""

import contextlib
import io
import json
import logging
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bevcli._version import __version__
from bevcli.config import as_table, config_of_table
from bevcli.errors import BevcliError, InputError, WeightsError
from bevcli.frame import Drive
from bevcli.inference.preprocess import Preprocessor
from bevcli.model import AnyPrecision
from bevcli.model.config import ModelConfig
from bevcli.model.temporal_model import TemporalModel, model_class
from bevcli.options import gather
from bevcli.parsing.documents import parse_json
from bevcli.printing import counted
from bevcli.workshop.engines import OnnxOptions
from bevcli.workshop.engines.export_form import ExportForm, Port
from bevcli.writing import check_output, whole_file

EXPORTERS = ("onnx", "onnxscript")  # packages that write the file
QUANTIZERS = ("onnx", "onnxruntime", "onnxruntime.quantization")  # modules that make it INT8, whatever engine runs it
NAME_SCOPES = "pkg.torch.onnx.name_scopes"  # the exporter's note of the modules that a node comes from
LARGEST_BYTES = 2**31  # protobuf's own limit, which every file of `bevcli export-onnx` keeps

# GridSample exists since opset 16, ScatterND with a sum since 16, LayerNormalization since 17, DeformConv since 19.
MIN_OPSET = {"operator": 19, "gridsample": 17}
# The part of the metadata that bevcli itself reads, to run the file: the contents of the model's TOML file as JSON,
# the number of cameras that may see one cell, whether the weights are random or those of the package, and the precision
# of backbone and neck.
METADATA = ("config", "cameras_per_cell", "untrained", "bundled", "precision")

QUANTIZED_PARTS = ("backbone", "image_detector", "neck")
QUANTIZED_OPERATORS = ("Conv", "Add", "MaxPool")
# Deformable convolutions stay in float32: rounding would move their samples.
DEFORMABLE = {"convolution", "offset_and_mask"}


def export_onnx(
    network: TemporalModel,
    out: Path,
    options: OnnxOptions | None = None,
    *,
    contents: Mapping[str, Any] | None = None,
    untrained: bool = False,
    bundled: bool = False,
    **changes: Any,
) -> None:
    """Write one step of a model as an ONNX file of standard operators.

    The memory of the previous frame enters the file: the BEV map of a recurrence, or the image features of the earlier
    frames of a window. The number of cameras is fixed, and the batch is one. Projections are inputs, so that the
    file serves any rig with this number of cameras. The file's metadata documents every input and output.

    Args:
        network: the plain model, `Model.network`.
        out: the file to write.
        options: default `OnnxOptions()`; its `rig` and `check` are for `bevcli export-onnx`.
        contents: of the model's TOML file, for the metadata. None takes those of the network's configuration.
        untrained: whether the weights are random, for the metadata.
        bundled: whether the weights are those of the package, for the metadata.
        changes: options as keywords.

    Raises:
        BevcliError: the extra bevcli[onnx] is not installed, the opset is too old, or the model has no exported
            form, because it looks at later frames or because its memory grows.
        OutputError: the file cannot be written.
    """
    onnx, _ = imported(*EXPORTERS)
    chosen = gather(OnnxOptions, options, changes)
    if chosen.opset < MIN_OPSET[chosen.deformable_convolution]:
        raise BevcliError(
            f"`opset={chosen.opset}` (`--opset`): expected {MIN_OPSET[chosen.deformable_convolution]} or newer with "
            f"`deformable_convolution={chosen.deformable_convolution}` (`--deformable-convolution "
            f"{chosen.deformable_convolution}`)"
        )
    config = network.config
    cameras = len(config.cameras) if chosen.cameras is None else chosen.cameras
    form: ExportForm = model_class(config).export_form(config, cameras)
    slots = min(chosen.cameras_per_cell, form.cameras)
    inputs, outputs = form.inputs, form.outputs(decode=chosen.decode)
    step = form.step(network, chosen.deformable_convolution, slots, decode=chosen.decode).eval()
    # The exporter tells about other packages and its own internals.
    with (
        errors_only("torch.onnx", "onnxscript", "onnx_ir"),
        warnings.catch_warnings(action="ignore"),
        contextlib.redirect_stdout(io.StringIO()),
        torch.no_grad(),
    ):
        program = torch.onnx.export(
            step,
            tuple(torch.zeros(port.shape, dtype=port.dtype) for port in inputs),
            input_names=[port.name for port in inputs],
            output_names=[port.name for port in outputs],
            opset_version=chosen.opset,
            dynamo=True,
            optimize=False,  # its pattern matching takes minutes; runtimes do the same when they load the file
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    _document(proto, inputs, outputs)
    contents = as_table(config) if contents is None else contents
    properties = metadata(form, outputs, contents, slots=slots, untrained=untrained, bundled=bundled)
    onnx.helper.set_model_props(proto, properties)
    onnx.checker.check_model(proto, full_check=True)
    with whole_file(out, parents=True) as unfinished:
        onnx.save(proto, str(unfinished))


def metadata(
    form: ExportForm,
    outputs: tuple[Port, ...],
    contents: Mapping[str, Any],
    *,
    slots: int,
    untrained: bool,
    bundled: bool,
) -> dict[str, str]:
    """The metadata of a file: text, or JSON where a value is not a name.

    outputs: of the file. slots: the number of cameras that may see one cell. The others as for `export_onnx`.
    """
    config, image, grid = form.config, form.config.image, form.config.bev_grid
    properties = {
        "model": config.name,
        "precision": "fp32",
        "bevcli_version": __version__,
        "resize": image.resize,
        "can_bus_quaternion": config.ego_motion.can_bus_quaternion,
        "inputs": {port.name: port.meaning for port in form.inputs},
        "outputs": {port.name: port.meaning for port in outputs},
        "classes": config.classes,
        "cameras": config.cameras,
        "image_size": image.size,
        "crop": image.crop_box,
        "padded_size": image.padded_size,
        "pad_value_bgr": config.image.pad_bgr,
        "x_range_m": grid.x_range_m,
        "y_range_m": grid.y_range_m,
        "bev_rows_columns": (grid.rows, grid.columns),
        "rate_hz": config.rate_hz,
        "max_gap_s": config.max_gap_s,
        "use_shift": config.ego_motion.shift,
        "use_rotation": config.ego_motion.rotation,
        "half_pixel_shift": image.half_pixel_shift,
        "bev_frame": {"level": config.bev_frame.level, "height_m": config.bev_frame.height_m},
        "cameras_per_cell": slots,
        "config": contents,
        "untrained": untrained,
        "bundled": bundled,
        **form.facts(),
    }
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in properties.items()}


def _document(proto: object, inputs: tuple[Port, ...], outputs: tuple[Port, ...]) -> None:
    graph = proto.graph  # type: ignore[attr-defined]
    meanings = {port.name: port.meaning for port in inputs + outputs}
    for value in (*graph.input, *graph.output):
        value.doc_string = meanings[value.name]
    for node in graph.node:
        scopes = [entry.value for entry in node.metadata_props if entry.key == NAME_SCOPES]
        parts = re.findall(r"'network\.([\w.]+)'", scopes[0] if scopes else "")
        # The part of the network that it belongs to, such as "backbone.stages.0.0"; "" outside of all parts.
        node.name = f"{parts[-1] if parts else ''}/{node.name}"
        # Where a node came from in our source code: a third of the file, and of use to nobody who runs it.
        del node.metadata_props[:]


@dataclass(frozen=True)
class ExportedFile:
    """The metadata of an exported file that describes its model."""

    config: ModelConfig  # of the model
    contents: dict[str, Any]  # the contents of the model's TOML file, its table of the tracker included
    cameras_per_cell: int  # the number of cameras that may see one cell of the BEV map
    untrained: bool  # whether the weights are random
    bundled: bool  # whether the weights are those of the package
    precision: AnyPrecision  # of backbone and neck, "fp32" or "int8"


def read_metadata(metadata: Mapping[str, str], file: Path) -> ExportedFile:
    """Reads the metadata of a file of `bevcli export-onnx`. Raises WeightsError, or ConfigError for its model."""
    missing = [name for name in METADATA if name not in metadata]
    if missing:
        raise WeightsError(
            f"{file}: its metadata lacks {', '.join(missing)} (expected a file of bevcli export-onnx of this version)"
        )
    contents, slots, untrained, bundled = (parse_json(metadata[name].encode(), file) for name in METADATA[:4])
    if not isinstance(contents, dict) or type(slots) is not int:
        raise WeightsError(
            f"{file}: its metadata config or cameras_per_cell is wrong (expected a table and an integer)"
        )
    precision: AnyPrecision = "int8" if metadata["precision"] == "int8" else "fp32"
    config = config_of_table(contents, str(file))
    # The file's images have one size, for every rig.
    config = replace(config, image=replace(config.image, focal_px=None, max_pixels=None))
    return ExportedFile(config, contents, slots, untrained is not False, bundled is True, precision)


def quantize(file: Path, images: Iterable[np.ndarray], out: Path) -> None:
    """Writes a copy of an exported file whose backbone and neck compute in INT8.

    Args:
        file: of `bevcli export-onnx`.
        images: the input `images` of some frames, (1, N, H, W, 3) float32 each, for the ranges of the activations.

    Raises:
        BevcliError: the extra bevcli[onnx] is not installed.
        WeightsError: the file cannot be loaded, is not of `bevcli export-onnx`, or is quantised already.
        OutputError: the file cannot be written.
    """
    onnx, _, quantization = imported(*QUANTIZERS)
    try:
        check_size(file)
        proto = onnx.load(str(file), load_external_data=False)
    except Exception as error:  # protobuf has classes of its own
        raise WeightsError(f"{file}: cannot be read as ONNX: {str(error).splitlines()[0]:.200}") from error
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    if read_metadata(metadata, file).precision != "fp32":
        raise WeightsError(f"{file}: is quantised already (expected a file of bevcli export-onnx)")
    check_output(out, file)
    clips = any(node.op_type == "Clip" and node.name.startswith(QUANTIZED_PARTS) for node in proto.graph.node)
    # Without advice about models that have not been simplified.
    with errors_only(""), whole_file(out, parents=True) as unfinished:
        quantization.quantize_static(
            proto,
            str(unfinished),
            CalibrationFeeds(proto, images),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=list(QUANTIZED_OPERATORS),
            nodes_to_quantize=quantized_nodes(proto.graph),
            per_channel=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
            extra_options={
                "WeightSymmetric": True,
                "ActivationSymmetric": False,
                # Before a ReLU6 a convolution has results far outside of 0 to 6, and few steps of 8 bits would be left
                # for these: its results are rounded only where another operator in INT8 reads them.
                "OpTypesToExcludeOutputQuantization": ["Conv"] if clips else [],
            },
        )
        quantized = onnx.load(str(unfinished))
        onnx.helper.set_model_props(quantized, metadata | {"precision": "int8"})
        onnx.save(quantized, str(unfinished))


def quantized_nodes(graph: Any) -> list[str]:
    """The names of the nodes of a file that compute in INT8. A name is "part.of.the.network/operator"."""
    constants = {value.name for value in graph.initializer}
    constants |= {name for node in graph.node if node.op_type == "Constant" for name in node.output}
    names = []
    for node in graph.node:
        parts = node.name.partition("/")[0].split(".")
        computes = node.op_type in ("Conv", "MaxPool") or (
            node.op_type == "Add" and not constants.intersection(node.input)  # a sum of maps
        )
        if computes and parts[0] in QUANTIZED_PARTS and not DEFORMABLE.intersection(parts):
            names.append(node.name)
    return names


class CalibrationFeeds:
    """The inputs for one frame after another, as ONNX Runtime asks for them.

    Matrices are the identity, other inputs but the images zero.
    """

    def __init__(self, proto: Any, images: Iterable[np.ndarray]) -> None:
        (onnx,) = imported("onnx")
        self.images, self.rest = iter(images), {}
        for value in proto.graph.input:
            tensor_type = value.type.tensor_type
            shape = [dimension.dim_value for dimension in tensor_type.shape.dim]
            self.rest[value.name] = np.zeros(shape, onnx.helper.tensor_dtype_to_np_dtype(tensor_type.elem_type))
            if shape[-2:] == [4, 4]:  # an embedding of the calibration divides by the determinant
                self.rest[value.name] += np.eye(4, dtype=self.rest[value.name].dtype)

    def get_next(self) -> Mapping[str, np.ndarray] | None:
        """See `onnxruntime.quantization.CalibrationDataReader`."""
        image = next(self.images, None)
        return None if image is None else self.rest | {"images": image}


def require(*names: str, extra: str = "onnx") -> None:
    """Raises BevcliError where one of these packages is not installed. extra: of bevcli, which installs them."""
    missing = [name for name in dict.fromkeys(name.partition(".")[0] for name in names) if find_spec(name) is None]
    if missing:
        raise BevcliError(f"{', '.join(missing)}: not installed; run pip install 'bevcli[{extra}]'")


def imported(*names: str) -> list[Any]:
    """These modules of optional packages. Raises BevcliError where a package is not installed."""
    require(*names)
    return [import_module(name) for name in names]


@contextlib.contextmanager
def errors_only(*names: str) -> Iterator[None]:
    """Inside, these loggers of other packages tell errors only; "" is the root of all loggers."""
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def check_size(file: Path) -> None:
    """Raises OSError for a missing file, ValueError for one that is larger than an exported file can be."""
    size = file.stat().st_size
    if size > LARGEST_BYTES:
        raise ValueError(f"it has {size} bytes (expected at most {LARGEST_BYTES})")


def calibration_images(config: ModelConfig, cameras: int, drives: Sequence[Drive], frames: int) -> Iterator[np.ndarray]:
    """Yields (1, N, H, W, 3) float32, the input `images` of an exported file, for frames of these drives.

    Args:
        config: of the model.
        cameras: N, the number of cameras of the exported file.
        drives: whose frames are read; frames without any image are left out.
        frames: at most so many, evenly spaced over all frames of all drives.

    Raises InputError where a frame cannot be read, a rig has another number of cameras, or no frame has an image.
    """
    empty = True
    all_frames = [(drive, index) for drive in drives for index in range(len(drive.stamps))]
    numbers = np.linspace(0, len(all_frames) - 1, min(frames, len(all_frames))).round().astype(int)
    preprocess = Preprocessor(config, pixels=True)
    for drive, index in (all_frames[number] for number in numbers):
        prepared = preprocess(drive.load(index))
        if len(prepared.assignment.cameras) != cameras:
            count = counted(len(prepared.assignment.cameras), "cameras")
            raise InputError(f"{drive.name}: has {count} (the file takes {cameras})")
        if prepared.frame.images:
            empty = False
            yield prepared.images.movedim(2, -1).numpy()
    if empty:
        names = ", ".join(drive.name for drive in drives)
        raise InputError(
            f"{names}: none of the {len(numbers)} frames for the calibration has an image; add their images"
        )
