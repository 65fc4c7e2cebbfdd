"""`quantize`: a copy of an exported file whose backbone and neck compute in INT8.

ONNX Runtime's static quantisation after training: weights in 8 bits, one scale for each output channel; activations in
8 bits, one scale a tensor, from the smallest and the largest value of the calibration images. Everything after the neck
stays in float32: it is a small part of the work, and rounding it would move boxes.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import WeightsError
from bevcli.workshop.engines.engine import check_size, errors_only, require
from bevcli.workshop.engines.exported import read_metadata
from bevcli.writing import check_output, whole_file

QUANTIZED_PARTS = ("backbone", "neck")
QUANTIZED_OPERATORS = ("Conv", "Add", "MaxPool")
# Deformable convolutions stay in float32: rounding would move their samples.
DEFORMABLE = {"convolution", "offset_and_mask"}


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
    require("onnx", "onnxruntime")
    import onnx
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static

    try:
        check_size(file)
        proto = onnx.load(str(file), load_external_data=False)
    except Exception as error:  # protobuf has classes of its own
        raise WeightsError(f"{file}: cannot be read as ONNX: {str(error).splitlines()[0]:.200}") from error
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    if read_metadata(metadata, file).precision != "fp32":
        raise WeightsError(f"{file}: is quantised already (expected a file of bevcli export-onnx)")
    check_output(out, file)
    # Without advice about models that have not been simplified.
    with errors_only(""), whole_file(out, parents=True) as unfinished:
        quantize_static(
            proto,
            str(unfinished),
            _reader(proto, images),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=list(QUANTIZED_OPERATORS),
            nodes_to_quantize=quantized_nodes(proto.graph),
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            extra_options={
                "WeightSymmetric": True,
                "ActivationSymmetric": False,
                "OpTypesToExcludeOutputQuantization": _unrounded(proto.graph),
            },
        )
        quantized = onnx.load(str(unfinished))
        onnx.helper.set_model_props(quantized, metadata | {"precision": "int8"})
        onnx.save(quantized, str(unfinished))


def quantized_nodes(graph: Any) -> list[str]:
    """The names of the nodes of a file that compute in INT8. A name is "part.of.the.network/operator"."""
    constants = {value.name for value in graph.initializer}
    constants |= {name for node in graph.node if node.op_type == "Constant" for name in node.output}
    found = []
    for node in graph.node:
        parts = node.name.partition("/")[0].split(".")
        computes = node.op_type in ("Conv", "MaxPool") or (
            node.op_type == "Add" and not constants.intersection(node.input)  # a sum of maps
        )
        if computes and parts[0] in QUANTIZED_PARTS and not DEFORMABLE.intersection(parts):
            found.append(node.name)
    return found


def _unrounded(graph: Any) -> list[str]:
    """Operators whose results are rounded only where another one in INT8 reads them.

    Before a ReLU6 a convolution has results far outside of 0 to 6, and few steps of 8 bits would be left for these.
    """
    clips = [node for node in graph.node if node.op_type == "Clip" and node.name.startswith(QUANTIZED_PARTS)]
    return ["Conv"] if clips else []


def _reader(proto: Any, images: Iterable[np.ndarray]) -> Any:
    """The inputs for one frame after another; matrices are the identity, other inputs but the images zero."""
    import onnx
    from onnxruntime.quantization import CalibrationDataReader

    rest = {}
    for value in proto.graph.input:
        kind = value.type.tensor_type
        shape = [dimension.dim_value for dimension in kind.shape.dim]
        rest[value.name] = np.zeros(shape, onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type))
        if shape[-2:] == [4, 4]:  # an embedding of the calibration divides by the determinant
            rest[value.name] += np.eye(4, dtype=rest[value.name].dtype)
    feeds = (rest | {"images": image} for image in images)

    class Frames(CalibrationDataReader):
        def get_next(self) -> Mapping[str, np.ndarray] | None:
            return next(feeds, None)

    return Frames()
