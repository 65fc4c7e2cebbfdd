"""`quantize`: a copy of an exported file whose backbone and neck compute in INT8.

ONNX Runtime's static quantisation after training: weights in 8 bits, one scale for each output channel; activations in
8 bits, one scale a tensor, from the smallest and the largest value of the calibration images. Everything after the neck
stays in float32: it is a small part of the work, and rounding it would move boxes.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.engines.engine import check_size
from bevcli.engines.exported import read_metadata
from bevcli.engines.packages import require
from bevcli.errors import OutputError, WeightsError

QUANTIZED_PARTS = ("backbone", "neck")
QUANTIZED_OPERATORS = ("Conv", "Add", "MaxPool")
# Deformable convolutions stay in float32: rounding would move their samples.
DEFORMABLE = {"convolution", "offset_and_mask"}


def quantize(file: Path, images: Iterable[np.ndarray], out: Path) -> None:
    """Writes a copy of an exported file whose backbone and neck compute in INT8.

    Args:
        file: of `bevcli export-onnx`.
        images: the input `images` of some frames, (1, N, H, W, 3) float32 each, for the ranges of the activations.
        out: the file to write.

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
    nodes = quantized_nodes(proto.graph)
    level, logger = logging.ERROR, logging.getLogger()
    before = logger.level
    logger.setLevel(level)  # its advice about models that have not been simplified
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".quantize-", dir=out.parent) as folder:
            fresh = Path(folder) / out.name
            quantize_static(
                proto,
                str(fresh),
                _Frames(proto, images),
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=list(QUANTIZED_OPERATORS),
                nodes_to_quantize=nodes,
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                extra_options={"WeightSymmetric": True, "ActivationSymmetric": False},
            )
            quantized = onnx.load(str(fresh))
            onnx.helper.set_model_props(quantized, metadata | {"precision": "int8"})
            onnx.save(quantized, str(fresh))
            fresh.replace(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written: {error.strerror}") from error
    finally:
        logger.setLevel(before)


def quantized_nodes(graph: Any) -> list[str]:
    """The names of the nodes of a file that compute in INT8. A name is "part.of.the.network/operator"."""
    constants = {value.name for value in graph.initializer}
    constants |= {name for node in graph.node if node.op_type == "Constant" for name in node.output}
    found = []
    for node in graph.node:
        parts = node.name.partition("/")[0].split(".")
        is_sum_of_maps = node.op_type == "Add" and not constants.intersection(node.input)
        if (
            parts[0] in QUANTIZED_PARTS
            and not DEFORMABLE.intersection(parts)
            and (node.op_type in ("Conv", "MaxPool") or is_sum_of_maps)
        ):
            found.append(node.name)
    return found


class _Frames:
    """Feeds the images of one frame after another to ONNX Runtime; matrices are the identity, other inputs zero."""

    def __init__(self, proto: Any, images: Iterable[np.ndarray]) -> None:
        import onnx

        self._rest = {}
        for value in proto.graph.input:
            kind = value.type.tensor_type
            shape = [dimension.dim_value for dimension in kind.shape.dim]
            rest = np.zeros(shape, onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type))
            if shape[-2:] == [4, 4]:  # an embedding of the calibration divides by the determinant
                rest += np.eye(4, dtype=rest.dtype)
            self._rest[value.name] = rest
        self._images: Iterator[np.ndarray] = iter(images)

    def get_next(self) -> Mapping[str, np.ndarray] | None:
        """The inputs for the next frame, None after the last."""
        images = next(self._images, None)
        return None if images is None else self._rest | {"images": images}

    def __iter__(self) -> _Frames:
        return self

    def __next__(self) -> Mapping[str, np.ndarray]:
        feed = self.get_next()
        if feed is None:
            raise StopIteration
        return feed
