"""Weights and images by a rule, so that the comparison with the released code needs no download.

The reference numbers in tests/data were computed with the same rule: every tensor is one draw from a generator that is
seeded by the CRC-32 of its official key, and its scale depends on the kind of tensor.
"""

import math
import re
import zlib
from functools import cache

import numpy as np
from numpy.typing import NDArray

# Pattern of the key, then the factor on a draw divided by the root of the fan-in; or mean and deviation of a draw.
_OVER_FAN_IN = (
    (r"conv_offset\.weight$", 0.5),
    (r"(^img_backbone\.|\.fusion\.layers\.)", math.sqrt(2)),
    (r"^img_neck\.", 0.5),
    (r"transformer\.reference_points\.weight$", 2.0),
    (r"\.decoder\..*(attn\.out_proj|ffns\.0\.layers\.1)\.weight$", 0.3),
    (r"\.decoder\..*output_proj\.weight$", 0.4),
    (r".*", 1.0),
)
_PLAIN = (
    (r"running_mean$", 0.0, 0.05),
    (r"sampling_offsets\.bias$", 0.0, 2.0),
    (r"conv_offset\.bias$", 0.0, 0.5),
    (r"(bev|query)_embedding\.weight$", 0.0, 1.0),
    (r"((row|col)_embed\.weight|level_embeds|cams_embeds)$", 0.0, 0.5),
    (r"(^img_backbone\.layer\d+\.\d+\.bn3|\.fusion\.layers\.\d+\.bn2)\.weight$", 0.25, 0.0125),
)


def stream(name: str) -> np.random.Generator:
    """The random generator of a name."""
    return np.random.Generator(np.random.PCG64(zlib.crc32(name.encode())))


def rule_tensor(key: str, shape: tuple[int, ...], stem_gain: float) -> np.ndarray:
    """A tensor of a state dict, by its official key and shape."""
    if key.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    if key.endswith("running_var"):
        return (0.8 + 0.4 * stream(key).random(shape)).astype(np.float32)
    draw = stream(key).standard_normal(shape)
    for pattern, mean, deviation in _PLAIN:
        if re.search(pattern, key):
            return (mean + deviation * draw).astype(np.float32)
    if len(shape) == 1:
        return (1 + 0.05 * draw if key.endswith("weight") else 0.05 * draw).astype(np.float32)
    root = math.sqrt(math.prod(shape[1:]))
    if re.search(r"cls_branches\.\d+\.6\.weight$", key):
        return (2 * (draw - draw.mean(axis=1, keepdims=True)) / root).astype(np.float32)
    gain = next(factor for pattern, factor in _OVER_FAN_IN if re.search(pattern, key))
    gain *= stem_gain if key == "img_backbone.conv1.weight" else 1.0
    return (gain * draw / root).astype(np.float32)


@cache
def rule_image(frame: int, camera: str, height: int = 900, width: int = 1600) -> NDArray[np.uint8]:
    """(H, W, 3) BGR: blocks of 100 pixels, blocks of 25 pixels and noise."""
    random = stream(f"image/{frame}/{camera}")
    coarse = random.integers(0, 150, (height // 100, width // 100, 3))
    medium = random.integers(-30, 31, (height // 25, width // 25, 3))
    fine = random.integers(-8, 9, (height, width, 3))
    blocks = np.kron(coarse, np.ones((100, 100, 1), int)) + np.kron(medium, np.ones((25, 25, 1), int))
    return np.clip(50 + fine + blocks, 0, 255).astype(np.uint8)
