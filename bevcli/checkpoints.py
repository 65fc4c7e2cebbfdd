"""Weights files: reads the official .pth and our .safetensors into the state dict of our model."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import resources
from pathlib import Path

import safetensors
import torch
from torch import Tensor

from bevcli.config import known_models, load_config
from bevcli.errors import BevcliError, ConfigError, InputError, WeightsError
from bevcli.model.config import ModelConfig
from bevcli.model.temporal_model import OfficialNames, Renames, TemporalModel, build_model
from bevcli.parsing.files import open_regular
from bevcli.parsing.pth import Placeholder, read_pth
from bevcli.printing import counted
from bevcli.registry import entries, load

# The types of numbers that weights may have, and the end of the only keys whose numbers are integers.
FLOATS = (torch.float32, torch.float16, torch.bfloat16, torch.float64)
INTEGER_KEY = "num_batches_tracked"
PREFIXES = r"(?:(?:module|model)\.)*"  # of all names: DistributedDataParallel, Lightning
AVERAGES = r"ema[_.]|n_averaged$"  # MMCV's EMAHook, PyTorch's AveragedModel
AVERAGED_PREFIXES = r"(?:(?:ema_)?(?:module|model)\.|ema[_.])*"  # where a file has averages only
LARGEST_SIZE = 2**40  # elements of a tensor, repeated ones included
WRAPPERS = ("state_dict", "model", "model_state_dict")  # keys that a file may hold its state dict under
LEAST_SHARE = 0.5  # of a model's tensors, that a file must hold for a difference in words
OFFICIAL = ("img_backbone.", "img_neck.", "pts_bbox_head.")  # of names in the released files


@dataclass(frozen=True)
class Checkpoint:
    """The contents of a weights file."""

    path: Path  # the file
    state: Mapping[str, Tensor]  # state dict with our key names
    official: bool  # whether the file uses the key names of the released code
    facts: Mapping[str, str] = field(default_factory=dict)  # metadata in the file, such as its epoch
    left_out: str = ""  # what of the file is for training only and was left out of `state`; "" for nothing
    # classes and functions in the file whose objects were not read, such as "numpy.dtype"
    not_read: tuple[str, ...] = ()

    @cached_property
    def models(self) -> tuple[str, ...]:
        """Names of the known models that the state dict fits."""
        return tuple(name for name in known_models() if not compare(self.state, _expected_of(name)))

    @cached_property
    def nearest(self) -> str:
        """The known model with the fewest different tensors."""
        return min(known_models(), key=lambda name: sum(map(len, compare(self.state, _expected_of(name)).values())))

    @cached_property
    def own_classes(self) -> int | None:
        """The number of classes of the file, where it is the nearest model with another number; else None."""
        return classes_instead(self.state, _expected_of(self.nearest), len(load_config(self.nearest).classes))

    @property
    def misfit(self) -> str:
        """The known model that is nearest, and the difference from it, for an error of a file that fits none."""
        expected, count = _expected_of(self.nearest), len(load_config(self.nearest).classes)
        advice = ": name its own by `model` (`--model FILE.toml`)"
        if self.own_classes is not None:
            advice = f": `bevcli weights model-file {self.path} my.toml` writes its model file"
        what = difference(self.state, expected, count)
        return f"fits none of the known models; nearest is {self.nearest}: {what}{advice}"

    @property
    def parameters(self) -> int:
        """Number of values in all tensors, running statistics of batch norms included."""
        return sum(tensor.numel() for tensor in self.state.values())


def load_weights(path: Path, model: TemporalModel, model_file: str = "") -> Checkpoint:
    """Loads a weights file into a model, in place. Keys and shapes must be exactly those of the model.

    Args:
        path: an official .pth or a .safetensors.
        model: unchanged where the file does not fit.
        model_file: name or TOML file of the model, for the message; by default the model's name.

    Raises WeightsError that names the known model that the file fits, or else every key that differs.
    """
    checkpoint = read_checkpoint(path)
    require_fit(checkpoint, model_file or model.config.name, model.state_dict())
    model.load_state_dict(dict(checkpoint.state))
    return checkpoint


def require_fit(checkpoint: Checkpoint, model: str, expected: Mapping[str, Tensor]) -> None:
    """Raises WeightsError where a weights file does not fit a model.

    model: its name or TOML file. expected: its state dict.
    """
    by_kind = compare(checkpoint.state, expected)
    if not by_kind:
        return
    differences = "; ".join(f"{len(keys)} {kind}: {', '.join(keys)}" for kind, keys in by_kind.items())
    count = _class_count(model)
    if count is not None and classes_instead(checkpoint.state, expected, count) is not None:
        differences = difference(checkpoint.state, expected, count)
    if checkpoint.models:
        first = "; ".join(f"{len(keys)} {kind}, such as {keys[0]}" for kind, keys in by_kind.items())
        differences = f"it holds weights of {' or '.join(checkpoint.models)}; {first}"
    raise WeightsError(
        f"{checkpoint.path}: does not fit model {model}: {differences}; `bevcli train` starts from whatever fits "
        f"(`--model {model} --weights {checkpoint.path}`)"
    )


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads an official .pth or a .safetensors, with official key names or ours.

    Code in the file never runs: objects other than tensors and plain values are left out. Raises WeightsError where
    the file has no state dict, or where a tensor has a wrong type or contains NaN or infinity.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: weights file not found")
    not_read: tuple[str, ...] = ()
    left_out: list[str] = []
    state: Mapping[str, Tensor]
    if path.suffix == ".safetensors":
        state, facts = read_safetensors(path, error=WeightsError)
    else:
        state, facts, not_read = _read_pth(path, left_out)
    state = _unwrapped(state, left_out)
    _check_numbers(path, state)
    official = any(key.startswith(OFFICIAL) for key in state)
    if official:
        state, parts = from_official(state)
        left_out += [parts] if parts else []
    return Checkpoint(path, state, official, facts, " and ".join(left_out), not_read)


def read_safetensors(path: Path, *, error: type[BevcliError] = InputError) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors by name, on the CPU, and the metadata.

    error: kind of exception for a file that is missing, damaged or no regular file.
    """
    open_regular(path, error=error).close()  # the library would wait for the writer of a pipe
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return tensors, dict(file.metadata() or {})
    except (safetensors.SafetensorError, OSError, ValueError, RuntimeError, AttributeError) as failure:
        reason = " ".join(str(failure).split())
        raise error(f"{path}: not a valid safetensors file ({reason:.200})") from None


def _unwrapped(state: Mapping[str, Tensor], left_out: list[str]) -> Mapping[str, Tensor]:
    """The state dict without running averages and prefixes of other programs, which `left_out` names then."""
    prefixes = PREFIXES
    kept = {key: tensor for key, tensor in state.items() if not re.match(f"{PREFIXES}({AVERAGES})", key)}
    if not kept:
        kept, prefixes = dict(state), AVERAGED_PREFIXES
    left_out += [f"{len(state) - len(kept)} running averages (ema_*)"] if len(kept) < len(state) else []
    matched_prefixes = {match[0] for match in (re.match(prefixes, key) for key in kept) if match}
    if len(matched_prefixes) != 1 or "" in matched_prefixes:
        return kept
    (prefix,) = matched_prefixes
    left_out.append(f'the prefix "{prefix}" of all names')
    return {key.removeprefix(prefix): tensor for key, tensor in kept.items()}


def bundled_weights(model: str) -> Path | None:
    """The weights file that comes with the package for a known model; None where there is none."""
    file = Path(str(resources.files("bevcli").joinpath("weights", f"{model}.safetensors")))
    return file if model in known_models() and file.is_file() else None


def compare(state: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> dict[str, list[str]]:
    """The differences between a state dict and the state dict of a model, by kind; empty if it fits.

    "missing": keys that the state dict lacks. "unexpected": keys that the model does not have. "misshapen": lines
    "key: expected (…), found (…)" for tensors of a wrong shape.
    """
    by_kind = {
        "missing": [key for key in expected if key not in state],
        "unexpected": [key for key in state if key not in expected],
        "misshapen": [
            f"{key}: expected {tuple(tensor.shape)}, found {tuple(state[key].shape)}"
            for key, tensor in expected.items()
            if key in state and tensor.shape != state[key].shape
        ],
    }
    return {kind: keys for kind, keys in by_kind.items() if keys}


def difference(state: Mapping[str, Tensor], expected: Mapping[str, Tensor], classes: int) -> str:
    """The difference between a state dict and that of a model in words. classes: number of the model's classes."""
    by_kind = compare(state, expected)
    fitting = len(expected) - len(by_kind.get("missing", ())) - len(by_kind.get("misshapen", ()))
    if fitting < LEAST_SHARE * len(expected):
        return f"{fitting} of its {len(expected)} tensors are in the file"
    class_count, parts = classes_instead(state, expected, classes, whole=False), []
    if class_count is not None:
        parts.append(f"{counted(class_count, 'classes')} instead of {classes}")
        del by_kind["misshapen"]
    words = {"missing": "missing", "unexpected": "too many", "misshapen": "of another shape"}
    for kind, keys in by_kind.items():
        parts.append(f"{counted(len(keys), 'tensors')} {words[kind]}{', such as' if len(keys) > 1 else ':'} {keys[0]}")
    return "; ".join(parts)


def classes_instead(
    state: Mapping[str, Tensor], expected: Mapping[str, Tensor], classes: int, *, whole: bool = True
) -> int | None:
    """The number of classes of a state dict, where each misshapen tensor has another number of rows for classes.

    None where that is not so. classes: number of the model's classes. whole: nothing else may differ.
    """
    by_kind = compare(state, expected)
    pairs = [
        (tensor.shape, state[key].shape)
        for key, tensor in expected.items()
        if key in state and tensor.shape != state[key].shape
    ]
    if not pairs or (whole and len(by_kind) > 1):
        return None
    counts = {theirs[0] if ours[:1] == (classes,) and theirs[1:] == ours[1:] else None for ours, theirs in pairs}
    return counts.pop() if len(counts) == 1 else None


def _class_count(model: str) -> int | None:
    try:
        return len(load_config(model).classes)
    except ConfigError:  # a name that is given for the message only
        return None


@cache
def _expected_of(model: str) -> Mapping[str, Tensor]:
    return expected_state(load_config(model))


def expected_state(config: ModelConfig) -> dict[str, Tensor]:
    """The state dict that a model needs, with tensors that have a shape but no contents."""
    with torch.device("meta"):
        return build_model(config).state_dict()


def _read_pth(path: Path, left_out: list[str]) -> tuple[dict[str, Tensor], dict[str, str], tuple[str, ...]]:
    file = read_pth(path)
    contents = state = file.contents
    if isinstance(contents, dict):
        wrapper = next((key for key in WRAPPERS if not isinstance(contents.get(key), Tensor | None)), "")
        state = contents[wrapper] if wrapper else contents
        left_out += [f'everything but "{wrapper}"'] if wrapper not in ("", WRAPPERS[0]) else []
    named = state if isinstance(state, dict) else {"": state}
    placeholders = {key: value for key, value in named.items() if isinstance(value, Placeholder)}
    hidden = [f"{key}: {value.made_by}".removeprefix(": ") for key, value in placeholders.items()]
    if hidden:
        raise WeightsError(
            f"{path}: is not safe to read: its tensors are hidden behind code ({hidden[0]:.100}), which was not run "
            "(expected tensors by name, at the top level or under state_dict or model)"
        )
    tensors = {key: tensor for key, tensor in named.items() if isinstance(key, str)}
    if not tensors or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise WeightsError(
            f"{path}: contains no state dict (expected tensors by name, at the top level or under state_dict or model)"
        )
    size = path.stat().st_size
    for name, tensor in tensors.items():
        # A tensor may repeat numbers by a stride of 0, but not by overlapping rows: those only inflate a small file.
        has_numbers = tensor.layout == torch.strided and not tensor.is_meta
        distinct = (
            math.prod(n for n, stride in zip(tensor.shape, tensor.stride(), strict=True) if stride)
            if has_numbers
            else 0
        )
        if not has_numbers or distinct > size or tensor.numel() > LARGEST_SIZE:
            raise WeightsError(
                f"{path}: tensor {name}: its shape {tuple(tensor.shape)} reaches beyond its numbers in the file"
            )
    meta = contents.get("meta")
    facts = {key: _fact(meta.get(key)) for key in ("epoch", "iter", "time")} if isinstance(meta, dict) else {}
    return (
        {key: tensor.detach() for key, tensor in tensors.items()},
        {key: fact for key, fact in facts.items() if fact},
        file.left_out,
    )


def _fact(value: object) -> str:
    """A plain value of a checkpoint's metadata as text, "" for anything else."""
    if isinstance(value, int) and abs(value) >= 2**62:
        return ""
    return str(value)[:200] if isinstance(value, str | int | float) else ""


def _check_numbers(path: Path, state: Mapping[str, Tensor]) -> None:
    """Raises WeightsError, which names the tensor, for a number type that weights do not have, for NaN or infinity."""
    for name, tensor in state.items():
        if tensor.dtype not in FLOATS and not name.endswith(INTEGER_KEY):
            dtype_name = str(tensor.dtype).removeprefix("torch.")
            expected = ", ".join(str(dtype).removeprefix("torch.") for dtype in FLOATS)
            raise WeightsError(f"{path}: tensor {name}: numbers of type {dtype_name} (expected {expected})")
        # Numbers that a stride of 0 repeats are checked once.
        for dimension, stride in enumerate(tensor.stride()):
            if stride == 0 and tensor.shape[dimension] > 1:
                tensor = tensor.narrow(dimension, 0, 1)
        bad = ~torch.isfinite(tensor.float())
        if bad.any():
            index = tuple(bad.nonzero()[0].tolist())
            raise WeightsError(
                f"{path}: tensor {name}: {int(bad.sum())} of {tensor.numel()} numbers are not finite, the first at "
                f"index {index}: {float(tensor[index])} (expected finite numbers): the file is damaged"
            )


# Of the parts that models share. All rules are applied to every key, in their order, after those of the model.
_RENAMES: Renames = (
    (r"^img_backbone\.layer(\d)\.", lambda m: f"backbone.stages.{int(m[1]) - 1}."),
    (r"^img_backbone\.", "backbone."),
    (r"\.conv_offset\.", ".offset_and_mask."),
    (r"^img_neck\.lateral_convs\.(\d)\.conv\.", r"neck.lateral.\1."),
    (r"^pts_bbox_head\.positional_encoding\.row_embed\.weight$", "bev_queries.row_embedding"),
    (r"^pts_bbox_head\.positional_encoding\.col_embed\.weight$", "bev_queries.column_embedding"),
    (r"^pts_bbox_head\.bev_embedding\.weight$", "bev_queries.embedding"),
    (r"^pts_bbox_head\.transformer\.level_embeds$", "image_tokens.level_embedding"),
    (r"^pts_bbox_head\.transformer\.cams_embeds$", "image_tokens.camera_embedding"),
    (r"^pts_bbox_head\.transformer\.can_bus_mlp\.norm\.", "bev_queries.can_bus_embedding.4."),
    (r"^pts_bbox_head\.transformer\.can_bus_mlp\.", "bev_queries.can_bus_embedding."),
    (r"^pts_bbox_head\.query_embedding\.weight$", "decoder.query_embedding"),
    (r"^pts_bbox_head\.transformer\.reference_points\.", "decoder.reference_points."),
    (r"^pts_bbox_head\.cls_branches\.", "detection_head.class_branches."),
    (r"^pts_bbox_head\.reg_branches\.", "detection_head.box_branches."),
    (r"^pts_bbox_head\.transformer\.encoder\.", "encoder."),
    (r"^pts_bbox_head\.transformer\.decoder\.", "decoder."),
    (r"^(encoder\..*)\.attentions\.0\.", r"\1.temporal_self_attention.attention."),
    (r"^(encoder\..*)\.attentions\.1\.deformable_attention\.", r"\1.spatial_cross_attention.attention."),
    (r"^(encoder\..*)\.attentions\.1\.output_proj\.", r"\1.spatial_cross_attention.attention.output_proj."),
    (r"\.attentions\.0\.attn\.", ".self_attention."),  # of all decoders
    (r"\.attentions\.1\.", ".cross_attention."),
    (r"\.value_proj\.", ".value_projection."),
    (r"\.output_proj\.", ".output_projection."),
    (r"\.ffns\.0\.layers\.0\.0\.", ".feed_forward.expand."),
    (r"\.ffns\.0\.layers\.1\.", ".feed_forward.reduce."),
)

# In the official files, but used in training only: weights of the loss, and further groups of object queries.
_TRAINING_ONLY = ("pts_bbox_head.code_weights",)
_OBJECT_QUERIES = "pts_bbox_head.query_embedding.weight"
_QUERIES_OF_A_GROUP = 900


def from_official(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """An official state dict with our key names, and the parts in words that only training uses and that it lacks.

    A key that no rule matches stays unchanged.
    """
    names = _names_of(state)
    rest, unused = names.without_unused(state)
    rest, groups = _first_group(rest)
    first_extra = sum(key.startswith("img_neck.lateral_convs.") and key.endswith(".weight") for key in rest)
    renames = [*names.renames, *_RENAMES]
    ours = {_our_name(key, first_extra, renames): x for key, x in rest.items() if key not in _TRAINING_ONLY}
    return ours, " and ".join(filter(None, (unused, groups)))


def _names_of(state: Mapping[str, Tensor]) -> OfficialNames:
    """The names of the model whose mark the state dict has; shared names only where it has none."""
    for name in entries("bevcli.models"):
        names: OfficialNames = load("bevcli.models", name).official_names
        if names.mark and any(re.match(names.mark, key) for key in state):
            return names
    return OfficialNames()


def _first_group(state: dict[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """The state dict with the first group of object queries only, and the others in words."""
    queries = state.get(_OBJECT_QUERIES)
    groups, rest = (1, 0) if queries is None or queries.ndim != 2 else divmod(len(queries), _QUERIES_OF_A_GROUP)
    if queries is None or groups < 2 or rest:
        return state, ""
    first = {**state, _OBJECT_QUERIES: queries[:_QUERIES_OF_A_GROUP].clone()}
    return first, f"{groups - 1} of {groups} groups of object queries"


def _our_name(key: str, first_extra: int, renames: Renames) -> str:
    output = re.match(r"^img_neck\.fpn_convs\.(\d+)\.conv\.(weight|bias)$", key)
    if output:
        level = int(output[1])
        module = f"output.{level}" if level < first_extra else f"extra.{level - first_extra}"
        return f"neck.{module}.{output[2]}"
    for pattern, replacement in renames:
        key = re.sub(pattern, replacement, key)
    return key
