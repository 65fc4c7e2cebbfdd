"""A backbone that starts from weights for ImageNet: key names of torchvision, timm and efficientnet-lite-pytorch."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from torch import Tensor

from bevcli.checkpoints import INTEGER_KEY, read_checkpoint
from bevcli.errors import WeightsError
from bevcli.model.config import ImageConfig
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.model.network import Network
from bevcli.workshop.training.warm_start import WarmStart

Normalisation = tuple[tuple[float, float, float], tuple[float, float, float]]  # mean and std of R, G and B
IMAGENET: Normalisation = ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375))
# By a key that a file of this origin has: the origin in words, the kind of its backbone, its usual normalisation.
ORIGINS: Mapping[str, tuple[str, str, Normalisation | None]] = {
    "backbone.conv1.weight": ("bevcli", "", None),
    "layer1.0.conv1.weight": ("torchvision or timm", "resnet", IMAGENET),
    "conv_stem.weight": ("timm", "efficientnet-lite", ((127.5,) * 3, (127.5,) * 3)),
    "_conv_stem.weight": ("efficientnet-lite-pytorch", "efficientnet-lite", ((127.0,) * 3, (128.0,) * 3)),
}
ALMOST = 1.0  # difference of two normalisations, on the scale 0 to 255, that no model notices
# The modules of an inverted residual block, in the order of a block without and with expansion.
TIMM_DEPTHWISE = {"conv_dw": "depthwise", "bn1": "depthwise_norm", "conv_pw": "project", "bn2": "project_norm"}
TIMM = {
    "conv_pw": "expand", "bn1": "expand_norm", "conv_dw": "depthwise", "bn2": "depthwise_norm",
    "conv_pwl": "project", "bn3": "project_norm",
}  # fmt: skip
PYTORCH = {
    "_expand_conv": "expand", "_bn0": "expand_norm", "_depthwise_conv": "depthwise", "_bn1": "depthwise_norm",
    "_project_conv": "project", "_bn2": "project_norm",
}  # fmt: skip


def start_backbone(file: Path, model: Network, model_file: str) -> tuple[WarmStart, tuple[str, ...]]:
    """Load, in place, the whole backbone of a model from a weights file; return what was loaded, and notes.

    Offsets of deformable convolutions, which ImageNet weights lack, keep the model's initial values.

    Args:
        file: a .pth or .safetensors with the key names of `ORIGINS`.
        model: unchanged where the file does not fit.
        model_file: name or TOML file of the model, for the messages.

    Raises WeightsError for a file that cannot be read or has other key names, and for a tensor that does not fit.
    """
    state, config = read_checkpoint(file).state, model.config.backbone
    origin, kind, usual = next((ORIGINS[key] for key in ORIGINS if key in state), ("", "", None))
    if not origin or kind not in ("", config.kind):
        held = f"holds no backbone (expected a tensor named {' or '.join(ORIGINS)})"
        if origin:
            held = f'holds a backbone of kind "{kind}" (key names of {origin}), that of {model_file} is "{config.kind}"'
        raise WeightsError(f"{file}: {held}; choose other `backbone_weights`, or another kind in [backbone]")
    start, own = WarmStart(file, "", f"the backbone of {model_file}"), model.backbone.state_dict()
    rename = {"bevcli": _ours, "torchvision or timm": _of_resnet}.get(origin) or _of_blocks(config, origin)
    found = {rename(key): tensor for key, tensor in state.items()}
    for key, tensor in own.items():
        part = _part(key)
        if key in found and found[key].shape == tensor.shape:
            start.count("loaded", part, "", tensor.numel())
            own[key] = found[key]
        elif key not in found and ("offset_and_mask" in key or key.endswith(INTEGER_KEY)):
            start.count("new", part, "not in the file", tensor.numel(), key)
        else:
            shapes = [" × ".join(map(str, each.shape)) for each in (tensor, found.get(key)) if each is not None]
            what = f"has the shape {shapes[1]}" if key in found else "is not there"
            raise WeightsError(
                f"{file}: does not fit the backbone of {model_file}: {key} (expected {shapes[0]}) {what}; choose other "
                "`backbone_weights`, or change [backbone]"
            )
    unused = [(key, tensor) for key, tensor in found.items() if key not in own]
    start.count("unused", "other parts", "not in the backbone", sum(x.numel() for _, x in unused), *_first(unused))
    model.backbone.load_state_dict(own)
    return start, tuple(_notes(usual, model.config.image, start))


def _notes(usual: Normalisation | None, image: ImageConfig, start: WarmStart) -> list[str]:
    """A note where a model's images are not normalised as those that the weights were trained on."""
    if usual is None:
        return []
    pairs = zip((*usual[0], *usual[1]), (*image.mean, *image.std), strict=True)
    if image.color_order == "rgb" and all(abs(one - other) <= ALMOST for one, other in pairs):
        return []
    text = f"{start.file}: such weights usually take images with mean {list(usual[0])} and std {list(usual[1])}"
    return [f"{text} in RGB; the model's are {list(image.mean)}, {list(image.std)} in {image.color_order.upper()}"]


def _first(tensors: list[tuple[str, Tensor]]) -> list[str]:
    return [key for key, _ in tensors[:1]]


def _part(key: str) -> str:
    stage = re.match(r"stages\.(\d+)\.", key)
    return f"backbone: stage {int(stage[1]) + 1}" if stage else "backbone: stem"


def _ours(key: str) -> str:
    return key.removeprefix("backbone.")


def _of_resnet(key: str) -> str:
    return re.sub(r"^layer(\d)\.", lambda match: f"stages.{int(match[1]) - 1}.", key)


def _of_blocks(config: object, origin: str) -> Callable[[str], str]:
    """The function that gives the name, in the backbone, of a key of an EfficientNet-lite."""
    assert isinstance(config, EfficientNetLiteConfig)
    stage_of = [(stage - 1, block) for stage in range(1, 8) for block in range(config.blocks(stage))]

    def of_pytorch(key: str) -> str:
        match = re.match(r"^_blocks\.(\d+)\.(\w+)\.(\w+)$", key)
        if match and int(match[1]) < len(stage_of) and match[2] in PYTORCH:
            stage, block = stage_of[int(match[1])]
            return f"stages.{stage}.{block}.{PYTORCH[match[2]]}.{match[3]}"
        stem = {"_conv_stem": "conv1", "_bn0": "bn1", "_bn1": "head_norm"}
        return re.sub(r"^\w+", lambda name: stem.get(name[0], name[0]), key)

    def of_timm(key: str) -> str:
        match = re.match(r"^blocks\.(\d+)\.(\d+)\.(\w+)\.(\w+)$", key)
        modules = TIMM_DEPTHWISE if match and match[1] == "0" else TIMM
        if match and match[3] in modules:
            return f"stages.{match[1]}.{match[2]}.{modules[match[3]]}.{match[4]}"
        return re.sub(r"^conv_stem\.", "conv1.", key)

    return of_timm if origin == "timm" else of_pytorch
