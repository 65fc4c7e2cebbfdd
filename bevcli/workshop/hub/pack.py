"""`pack_model`: a folder that the Hugging Face Hub takes, from which `load_model("hf:…")` makes the same model."""

import hashlib
import json
from pathlib import Path
from typing import Any

import msgspec
import safetensors.torch

from bevcli._version import __version__
from bevcli.checkpoints import expected_state, read_checkpoint, require_fit
from bevcli.config import TRAINING, as_table, config_of_table, read_model_file
from bevcli.errors import OutputError, WeightsError
from bevcli.inference.load import tracker_of_table, weights_file
from bevcli.options import gather
from bevcli.published import Known
from bevcli.weights.options import PackOptions
from bevcli.workshop.hub.card import facts_of, model_card
from bevcli.workshop.hub.download import CARD, CONFIG, FORMAT, WEIGHTS, PackedConfig
from bevcli.writing import write_whole


def pack_model(
    model: str | Path, folder: str | Path, options: PackOptions | None = None, **changes: Any
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write config.json, model.safetensors and README.md, a model card, into a folder. Nothing is sent anywhere.

    The tensors are those of the weights file, with the types that they have there.

    Args:
        model: its name or FILE.toml, as `load_model` takes it.
        folder: made where it is missing.
        options: see `PackOptions`.
        changes: options as keywords: `weights`, `licence`, `datasets`, `scores`, `scored_on` and `force`.

    Returns the files, and notes: what the folder or the card lacks.

    Raises:
        ConfigError: the model's file is missing or wrong.
        WeightsError: there are no weights, or they do not fit.
        OutputError: a file exists, or cannot be written.
    """
    chosen, name, out = gather(PackOptions, options, changes), str(model), Path(folder)
    targets = [out / each for each in (CONFIG, WEIGHTS, CARD)]
    there = next((target for target in targets if target.exists()), None)
    if there is not None and not chosen.force:
        raise OutputError(
            f"{there}: already exists; choose another folder, or pass `force=True` (`--force`) to overwrite it"
        )
    if name.endswith(".toml") and chosen.weights is None:
        raise WeightsError(f"{name}: a model file holds no weights: pass `weights` (`--weights FILE`)")
    contents, file = read_model_file(name)
    config = config_of_table(contents, file)
    checkpoint = read_checkpoint(weights_file(chosen.weights or Path(name)))
    require_fit(checkpoint, name, expected_state(config))
    table = as_table(config, tracker_of_table(contents, config, file))
    if TRAINING in contents:
        table[TRAINING] = contents[TRAINING]
    tensors = {key: tensor.contiguous() for key, tensor in checkpoint.state.items()}
    weights = safetensors.torch.save(tensors, dict(checkpoint.facts))
    known = Known(hashlib.sha256(weights).hexdigest(), len(weights))
    facts = facts_of(name, checkpoint, chosen)
    packed = PackedConfig(
        library_name="bevcli", bevcli_version=__version__, format=FORMAT, weights=known, model=table, limit=facts.limit
    )
    texts = [
        json.dumps(msgspec.to_builtins(packed), indent=1, ensure_ascii=False) + "\n",
        model_card(config, facts, checkpoint.parameters),
    ]
    for target, content in zip(targets, (texts[0].encode(), weights, texts[1].encode()), strict=True):
        write_whole(target, content, parents=True)
    notes = list(facts.missing)
    if any(own.mesh for own in config.class_settings.values()):
        notes.append("meshes of classes are files of this machine: the folder has none")
    return tuple(targets), tuple(notes)
