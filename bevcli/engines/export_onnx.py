"""`export_onnx`: writes one step of a model as an ONNX file."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import torch

from bevcli.engines.export_parts import DeformableConvolution, ExportedStep
from bevcli.engines.interface import Port, input_ports, metadata, output_ports
from bevcli.engines.packages import require
from bevcli.errors import BevcliError, OutputError
from bevcli.model.bevformer import BEVFormer, BEVFormerBase
from bevcli.model.uniad import UniAD

# GridSample exists since opset 16, ScatterND with a sum since 16, LayerNormalization since 17, DeformConv since 19.
MIN_OPSET = {"operator": 19, "gridsample": 17}


def export_onnx(
    network: BEVFormerBase,
    out: Path,
    *,
    opset: int = 19,
    deformable_convolution: DeformableConvolution = "operator",
    cameras: int | None = None,
    decode: bool = False,
) -> None:
    """Writes one recurrent step of a model as an ONNX file of standard operators.

    The number of cameras is fixed, and the batch is one. Projections are inputs, so that the file serves any rig with
    this number of cameras. The file's metadata documents every input and output.

    Args:
        network: the plain model, `Model.network`.
        out: the file to write.
        opset: version of the operators.
        deformable_convolution: "operator" uses DeformConv (opset 19), "gridsample" writes it with GridSample, for
            runtimes without it. Models without deformable convolutions are the same in both.
        cameras: number of cameras of the rig. None takes the model's own.
        decode: add the outputs boxes, scores and classes.

    Raises:
        BevcliError: the extra bevcli[onnx] is not installed, the opset is too old, or the model is a BEVFormerV2 or a
            UniAD.
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
    if not isinstance(network, BEVFormer) or isinstance(network, UniAD) or config.image.crop is not None:
        raise BevcliError(
            f"{config.name}: BEVFormerV2, UniAD and models that crop images cannot be exported yet "
            "(expected a recurrent BEVFormer, such as tiny, small, base or demo)"
        )
    inputs = input_ports(config, len(config.cameras) if cameras is None else cameras)
    outputs = output_ports(config, decode=decode)
    step = ExportedStep(network, deformable_convolution, decode=decode).eval()
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
    onnx.helper.set_model_props(proto, metadata(config, inputs, outputs))
    onnx.checker.check_model(proto, full_check=True)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        onnx.save(proto, str(out))
    except OSError as error:
        raise OutputError(f"{out}: cannot be written: {error.strerror}") from error


def _document(proto: object, inputs: tuple[Port, ...], outputs: tuple[Port, ...]) -> None:
    graph = proto.graph  # type: ignore[attr-defined]
    meanings = {port.name: port.meaning for port in inputs + outputs}
    for value in (*graph.input, *graph.output):
        value.doc_string = meanings[value.name]
    for node in graph.node:
        # Where a node came from in our source code: a third of the file, and of use to nobody who runs it.
        del node.metadata_props[:]


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
