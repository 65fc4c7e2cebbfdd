"""`export_onnx`: writes one step of a model as an ONNX file."""

import contextlib
import io
import json
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from bevcli._version import __version__
from bevcli.config import as_table
from bevcli.errors import BevcliError
from bevcli.model.temporal_model import TemporalModel
from bevcli.options import gather
from bevcli.workshop.engines.engine import errors_only, require
from bevcli.workshop.engines.export_form import ExportForm, Port, export_form
from bevcli.workshop.engines.options import OnnxOptions
from bevcli.writing import whole_file

NAME_SCOPES = "pkg.torch.onnx.name_scopes"  # the exporter's note of the modules that a node comes from

# GridSample exists since opset 16, ScatterND with a sum since 16, LayerNormalization since 17, DeformConv since 19.
MIN_OPSET = {"operator": 19, "gridsample": 17}


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
    require("onnx", "onnxscript")
    import onnx

    chosen = gather(OnnxOptions, options, changes)
    if chosen.opset < MIN_OPSET[chosen.deformable_convolution]:
        raise BevcliError(
            f"`opset={chosen.opset}`: expected {MIN_OPSET[chosen.deformable_convolution]} or newer with "
            f"`deformable_convolution={chosen.deformable_convolution}`"
        )
    config = network.config
    form = export_form(config, len(config.cameras) if chosen.cameras is None else chosen.cameras)
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
    facts = metadata(form, outputs, contents, slots=slots, untrained=untrained, bundled=bundled)
    onnx.helper.set_model_props(proto, facts)
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
    facts = {
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
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in facts.items()}


def _document(proto: object, inputs: tuple[Port, ...], outputs: tuple[Port, ...]) -> None:
    graph = proto.graph  # type: ignore[attr-defined]
    meanings = {port.name: port.meaning for port in inputs + outputs}
    for value in (*graph.input, *graph.output):
        value.doc_string = meanings[value.name]
    for node in graph.node:
        node.name = f"{_part(node)}/{node.name}"
        # Where a node came from in our source code: a third of the file, and of use to nobody who runs it.
        del node.metadata_props[:]


def _part(node: object) -> str:
    """The part of the network that a node belongs to, such as "backbone.stages.0.0"; "" outside of all parts."""
    scopes = [entry.value for entry in node.metadata_props if entry.key == NAME_SCOPES]  # type: ignore[attr-defined]
    parts = re.findall(r"'network\.([\w.]+)'", scopes[0] if scopes else "")
    return parts[-1] if parts else ""
