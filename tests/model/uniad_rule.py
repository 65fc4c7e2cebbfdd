"""Weights and BEV maps by a rule, for the comparison with the released UniAD code. The goldens have the same rule.

golden_keys_uniad.json in tests/data: the keys and shapes of the official weights that BEVFormer base does not have with
the same shape, and under "unused" those without effect at inference.
"""

import json
import re

import numpy as np
import torch
from numpy.typing import NDArray
from original_reference import DATA, official_shapes
from stated_rule import rule_tensor, stream

STEM_GAIN = 1 / 57
# Pattern of a key, then what its tensor by the common rule is multiplied with, and what is added to that. They make the
# masks of different queries differ, and let tracks begin, live and end.
_CHANGES: tuple[tuple[str, float | list[float], float | list[float]], ...] = (
    (r"pts_bbox_head\.reg_branches\.\d+\.4\.weight", [0.1, 0.1, 1, 1, 0.1, 1, 1, 1, 1, 1], 0.0),
    (r"query_interact\.linear_(pos|feat)2\.weight", 0.25, 0.0),
    (r"seg_head\.things_mask_head\.blocks\.\d+\.(attn\.proj|mlp\.fc2)\.weight", 0.1, 0.0),
    (r"seg_head\.things_mask_head\.attnen\.q\.weight", 1.5, 0.0),
    (r"seg_head\.things_mask_head\.attnen\.linear\.0\.bias", 1.0, -1.0),
    (r"seg_head\.stuff_mask_head\.attnen\.linear\.0\.bias", 1.0, 0.1),
    (r"seg_head\.cls_branches\.5\.bias", 1.0, [-2.5, -1.5, -2.0]),
)


def uniad_shapes() -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights that inference needs."""
    file = json.loads((DATA / "golden_keys_uniad.json").read_text())
    of_base = {key: shape for key, shape in official_shapes("base").items() if key not in file["not_of_base"]}
    return of_base | {key: tuple(shape) for key, shape in file["keys"].items()}


def unused_shapes() -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights that have no effect at inference."""
    unused = json.loads((DATA / "golden_keys_uniad.json").read_text())["unused"]
    return {key: tuple(shape) for key, shape in unused.items()}


def uniad_tensor(key: str, shape: tuple[int, ...], class_bias: float = 3.35) -> np.ndarray:
    """A tensor of a state dict, by its official key and shape. class_bias: lowers the class logits of objects."""
    tensor = rule_tensor(key, shape, STEM_GAIN)
    if re.fullmatch(r"pts_bbox_head\.cls_branches\.\d+\.6\.bias", key):
        return (tensor.astype(np.float64) - class_bias).astype(np.float32)
    for pattern, factor, offset in _CHANGES:
        if re.fullmatch(pattern, key):
            rows = np.reshape(factor, (-1, 1)) if isinstance(factor, list) else factor
            return (tensor.astype(np.float64) * rows + np.asarray(offset)).astype(np.float32)
    return tensor


def uniad_state(prefix: str = "", class_bias: float = 3.35) -> dict[str, torch.Tensor]:
    """The official weights whose keys begin with `prefix`."""
    shapes = {key: shape for key, shape in uniad_shapes().items() if key.startswith(prefix)}
    return {key: torch.from_numpy(uniad_tensor(key, shape, class_bias)) for key, shape in shapes.items()}


def rule_bev(frame: int) -> torch.Tensor:
    """(1, 40000, 256) the BEV map of a frame, for the parts after the encoder."""
    bev = 1.5 * (0.8 * _smooth("bev/base") + 0.6 * _smooth(f"bev/{frame}"))
    return torch.from_numpy(bev.astype(np.float32))[None]


def _smooth(name: str, knots: int = 14, cells: int = 200) -> NDArray[np.float64]:
    """(cells², 256): normal random numbers at knots² places, linear in between, rows first."""
    values = stream(name).standard_normal((knots, knots, 256))
    place = np.linspace(0, knots - 1, cells)
    start = np.minimum(place.astype(int), knots - 2)
    share = place - start
    values = values[start] * (1 - share)[:, None, None] + values[start + 1] * share[:, None, None]
    values = values[:, start] * (1 - share)[None, :, None] + values[:, start + 1] * share[None, :, None]
    return values.reshape(cells**2, 256)
