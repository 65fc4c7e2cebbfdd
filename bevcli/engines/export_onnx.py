"""`export_onnx`: writes one step of a model as an ONNX file."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from bevcli.config import as_table
from bevcli.engines.export_parts import DeformableConvolution
from bevcli.engines.export_step import ExportedStep, RecurrentStep, WindowStep
from bevcli.engines.interface import Port, input_ports, metadata, output_ports
from bevcli.engines.packages import require
from bevcli.errors import BevcliError, OutputError
from bevcli.model.bevformer import BEVFormer, BEVFormerBase
from bevcli.model.bevformer_v2 import BEVFormerV2
from bevcli.model.uniad import UniAD

NAME_SCOPES = "pkg.torch.onnx.name_scopes"  # the exporter's note of the modules that a node comes from

# GridSample exists since opset 16, ScatterND with a sum since 16, LayerNormalization since 17, DeformConv since 19.
MIN_OPSET = {"operator": 19, "gridsample": 17}


def export_onnx(
    network: BEVFormerBase,
    out: Path,
    *,
    opset: int = 19,
    deformable_convolution: DeformableConvolution = "operator",
    cameras: int | None = None,
    cameras_per_cell: int = 2,
    decode: bool = False,
    contents: Mapping[str, Any] | None = None,
    untrained: bool = False,
    bundled: bool = False,
) -> None:
    """Writes one step of a BEVFormer or a BEVFormerV2 as an ONNX file of standard operators.

    The file of a BEVFormer takes the BEV map of the previous frame, that of a BEVFormerV2 the image features of the
    window's earlier frames. The number of cameras is fixed, and the batch is one. Projections are inputs, so that the
    file serves any rig with this number of cameras. The file's metadata documents every input and output.

    Args:
        network: the plain model, `Model.network`.
        out: the file to write.
        opset: version of the operators.
        deformable_convolution: "operator" uses DeformConv (opset 19), "gridsample" writes it with GridSample, for
            runtimes without it. Models without deformable convolutions are the same in both.
        cameras: number of cameras of the rig. None takes the model's own.
        cameras_per_cell: the number of cameras that may see one cell of the BEV map; at most two of nuScenes' do. The
            file fails on a rig where more see one. Its time for spatial cross-attention is proportional to it.
        decode: add the outputs boxes, scores and classes.
        contents: of the model's TOML file, for the metadata. None takes those of the network's configuration.
        untrained: whether the weights are random, for the metadata.
        bundled: whether the weights are those of the package, for the metadata.

    Raises:
        BevcliError: the extra bevcli[onnx] is not installed, the opset is too old, or the model is a UniAD or looks at
            later frames.
        OutputError: the file cannot be written.
    """
    require("onnx", "onnxscript")
    import onnx

    if opset < MIN_OPSET[deformable_convolution]:
        raise BevcliError(
            f"--opset {opset}: expected {MIN_OPSET[deformable_convolution]} or newer with "
            f"--deformable-convolution {deformable_convolution}"
        )
    config = network.config
    kind = _step_of(network)
    count = len(config.cameras) if cameras is None else cameras
    slots = min(cameras_per_cell, count)
    inputs = input_ports(config, count)
    outputs = output_ports(config, count, decode=decode)
    step = kind(network, deformable_convolution, slots, decode=decode).eval()
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            step,
            tuple(port.example() for port in inputs),
            input_names=[port.name for port in inputs],
            output_names=[port.name for port in outputs],
            opset_version=opset,
            dynamo=True,
            optimize=False,  # its pattern matching takes minutes; runtimes do the same when they load the file
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    _document(proto, inputs, outputs)
    contents = as_table(config) if contents is None else contents
    facts = metadata(config, inputs, outputs, contents, slots=slots, untrained=untrained, bundled=bundled)
    onnx.helper.set_model_props(proto, facts)
    onnx.checker.check_model(proto, full_check=True)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        onnx.save(proto, str(out))
    except OSError as error:
        raise OutputError(f"{out}: cannot be written: {error.strerror}") from error


def _step_of(network: BEVFormerBase) -> type[ExportedStep]:
    """The exported form of a model. Raises BevcliError for a model that has none."""
    config = network.config
    if isinstance(network, UniAD):
        raise BevcliError(
            f"{config.name}: a UniAD cannot be exported: the number of its tracks changes from frame to frame "
            "(expected a BEVFormer or a BEVFormerV2, such as tiny, base, demo or v2-t2)"
        )
    if isinstance(network, BEVFormerV2):
        if network.config.later_frames:
            raise BevcliError(
                f"{config.name}: a model that looks at later frames cannot be exported: frames is "
                f"{list(network.config.frames)} (expected a window that ends with 0, the current frame)"
            )
        return WindowStep
    assert isinstance(network, BEVFormer)
    return RecurrentStep


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


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps the exporter's notes about other packages and its own internals from the terminal."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
