"""VAD-tiny with weights by a rule, for the comparison with the released VAD code. The goldens have the same rule.

golden_keys_vad.json in tests/data: the keys and shapes of the official weights that BEVFormer tiny does not have with
the same shape, and those of tiny that VAD does not have.
"""

import json
import re

import numpy as np
import torch
from original_reference import DATA, official_shapes
from stated_rule import rule_tensor

from bevcli.checkpoints import from_official
from bevcli.config import load_config
from bevcli.workshop.vad.vad import VAD, VADConfig

STEM_GAIN = 1 / 57
HEAD = r"pts_bbox_head\."
ROOT = 512**0.5
# Metres a step, x and y, of the commands right, left, straight.
PATHS = [0.4, 2.5] * 6 + [-0.4, 2.5] * 6 + [0.0, 3.0] * 6
# Pattern of a key, then what its tensor by the common rule is multiplied with, and what is added to that. They make
# lines and modes differ, and put some objects and lines above the thresholds.
_CHANGES: tuple[tuple[str, float | list[float], float | list[float]], ...] = (
    (rf"{HEAD}cls_branches\.\d+\.6\.bias", 1.0, -1.7),
    (rf"{HEAD}reg_branches\.\d+\.4\.weight", [0.3, 0.3, 1, 1, 0.3, 1, 1, 1, 1, 1], 0.0),
    (rf"{HEAD}map_instance_embedding\.weight", ROOT, 0.0),
    (rf"{HEAD}map_pts_embedding\.weight", 0.3 * ROOT, 0.0),
    (rf"{HEAD}transformer\.map_reference_points\.weight", 2.0, 0.0),
    (rf"{HEAD}transformer\.map_decoder\..*(attn\.out_proj|ffns\.0\.layers\.1)\.weight", 0.3, 0.0),
    (rf"{HEAD}transformer\.map_decoder\..*output_proj\.weight", 0.4, 0.0),
    (rf"{HEAD}map_reg_branches\.\d+\.4\.weight", 0.5, 0.0),
    (rf"{HEAD}map_cls_branches\.\d+\.6\.bias", 1.0, -1.8),
    (rf"{HEAD}(motion_mode|ego)_query\.weight", 16.0, 0.0),
    (rf"{HEAD}(motion|motion_map|ego_agent|ego_map)_decoder\..*\.in_proj_weight", [2.0] * 512 + [1.0] * 256, 0.0),
    (rf"{HEAD}ego_fut_decoder\.4\.bias", 1.0, PATHS),
)


def vad_shapes() -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights."""
    file = json.loads((DATA / "golden_keys_vad.json").read_text())
    of_tiny = {key: shape for key, shape in official_shapes("tiny").items() if key not in file["not_of_tiny"]}
    return of_tiny | {key: tuple(shape) for key, shape in file["keys"].items()}


def vad_tensor(key: str, shape: tuple[int, ...]) -> np.ndarray:
    """A tensor of a state dict, by its official key and shape."""
    if key.endswith("map_code_weights"):
        return np.ones(shape, np.float32)
    tensor = rule_tensor(key, shape, STEM_GAIN)
    for pattern, factor, offset in _CHANGES:
        if re.fullmatch(pattern, key):
            rows = np.reshape(factor, (-1, *[1] * (len(shape) - 1))) if isinstance(factor, list) else factor
            return (tensor.astype(np.float64) * rows + np.asarray(offset)).astype(np.float32)
    return tensor


def rule_vad() -> VAD:
    """The whole model, in evaluation mode."""
    config = load_config("vad-tiny")
    assert isinstance(config, VADConfig)
    model = VAD(config).eval()
    state = {key: torch.from_numpy(vad_tensor(key, shape)) for key, shape in vad_shapes().items()}
    model.load_state_dict(from_official(state)[0])
    return model
