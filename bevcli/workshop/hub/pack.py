"""`pack_model`: a folder that the Hugging Face Hub takes, from which `load_model("hf:…")` makes the same model.

README.md is a model card, with the front matter that the Hugging Face Hub reads.
"""

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import safetensors.torch
import yaml

from bevcli._version import __version__
from bevcli.checkpoints import Checkpoint, bundled_weights, expected_state, read_checkpoint, require_fit
from bevcli.config import TRAINING, as_table, config_of_table, read_model_file
from bevcli.errors import InputError, OutputError, WeightsError
from bevcli.inference.load import tracker_of_table, weights_file
from bevcli.model.config import ModelConfig
from bevcli.options import gather
from bevcli.parsing.files import MIB, read_text
from bevcli.published import Known, all_weights
from bevcli.weights.options import PackOptions
from bevcli.workshop.hub.download import CARD, CONFIG, FORMAT, WEIGHTS, PackedConfig
from bevcli.writing import write_whole

PAPERS = {
    "BEVFormer": "https://arxiv.org/abs/2203.17270",
    "BEVFormerV2": "https://arxiv.org/abs/2211.10439",
    "UniAD": "https://arxiv.org/abs/2212.10156",
    "VAD": "https://arxiv.org/abs/2303.12077",
}
# Of the weights in the package: scores, their data, and a limit. docs/model-card.md has the whole tables.
RENDERED = "rendered drives of 20 frames (seeds from 1000000 on)"
BUNDLED: dict[str, tuple[dict[str, float], str, str]] = {
    "demo": (
        {"mAP": 0.559, "NDS": 0.638},
        f"40 {RENDERED}",
        "The weights were trained on rendered streets (`bevcli render`) and do not work on real images.",
    ),
    "photographs": (
        {"mAP": 0.477, "NDS": 0.508},
        f"3 {RENDERED}",
        "Trained on rendered streets (`bevcli render`); of real images they find cars, and invent some.",
    ),
}
PUBLISHED_DATA = "nuScenes validation split"


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
    pack_options, name, out = gather(PackOptions, options, changes), str(model), Path(folder)
    targets = [out / file_name for file_name in (CONFIG, WEIGHTS, CARD)]
    there = next((target for target in targets if target.exists()), None)
    if there is not None and not pack_options.force:
        raise OutputError(
            f"{there}: already exists; choose another folder, or pass `force=True` (`--force`) to overwrite it"
        )
    if name.endswith(".toml") and pack_options.weights is None:
        raise WeightsError(f"{name}: a model file holds no weights: pass `weights` (`--weights FILE`)")
    contents, file = read_model_file(name)
    config = config_of_table(contents, file)
    checkpoint = read_checkpoint(weights_file(pack_options.weights or Path(name)))
    require_fit(checkpoint, name, expected_state(config))
    table = as_table(config, tracker_of_table(contents, config, file))
    if TRAINING in contents:
        table[TRAINING] = contents[TRAINING]
    tensors = {key: tensor.contiguous() for key, tensor in checkpoint.state.items()}
    weights = safetensors.torch.save(tensors, dict(checkpoint.facts))
    content_hash = Known(hashlib.sha256(weights).hexdigest(), len(weights))
    card_facts = facts_of(name, checkpoint, pack_options)
    packed = PackedConfig(
        library_name="bevcli",
        bevcli_version=__version__,
        format=FORMAT,
        weights=content_hash,
        model=table,
        limit=card_facts.limit,
    )
    texts = [
        json.dumps(msgspec.to_builtins(packed), indent=1, ensure_ascii=False) + "\n",
        model_card(config, card_facts, checkpoint.parameters),
    ]
    for target, content in zip(targets, (texts[0].encode(), weights, texts[1].encode()), strict=True):
        write_whole(target, content, parents=True)
    notes = list(card_facts.missing)
    if any(settings.mesh for settings in config.class_settings.values()):
        notes.append("meshes of classes are files of this machine: the folder has none")
    return tuple(targets), tuple(notes)


@dataclass(frozen=True)
class CardFacts:
    """What a card states beside the model's configuration.

    Attributes:
        licence: of the weights; "" where none is known.
        datasets: that the weights were trained on.
        scores: by name.
        scored_on: the data of the scores.
        source: where the weights were published first; "" if that is not known.
        limit: a sentence on what the weights are not for; "" for none.
        rigs: the rigs of the training, as the metadata of the weights states them; "" if it does not.
    """

    licence: str = ""
    datasets: tuple[str, ...] = ()
    scores: Mapping[str, float] | None = None
    scored_on: str = ""
    source: str = ""
    limit: str = ""
    rigs: str = ""

    @property
    def missing(self) -> tuple[str, ...]:
        """Notes on what the card lacks, and the options that state it."""
        notes = {
            "no licence: others may not use the weights: pass `licence` (`--licence NAME`)": self.licence,
            "no data of the training: pass `datasets` (`--datasets NAME`)": self.datasets or self.limit,
            "no scores: pass `scores` (`--scores FILE.json`)": self.scores,
        }
        return tuple(f"the model card states {text}" for text, statement in notes.items() if not statement)


def facts_of(name: str, checkpoint: Checkpoint, options: PackOptions) -> CardFacts:
    """What is known of the weights of a model, and what the options state. Raises InputError for wrong scores."""
    rigs = checkpoint.facts.get("training_rigs", "")
    recorded = CardFacts(rigs=rigs)
    named = all_weights().get(name) if options.weights is None else None
    if checkpoint.path == bundled_weights(name):
        bundled_scores, scored_on, limit = BUNDLED[name]
        recorded = CardFacts("Apache-2.0", (), bundled_scores, scored_on, "", limit, rigs)
    elif named is not None:
        source, data = named.source, ("nuscenes",) if named.source.published else ()
        first_published = source.page or source.url
        recorded = CardFacts(source.licence, data, source.published, PUBLISHED_DATA, first_published, "", rigs)
    scores = recorded.scores if options.scores is None else _read_scores(options.scores)
    return CardFacts(
        options.licence or recorded.licence,
        options.datasets or recorded.datasets,
        scores,
        options.scored_on or (recorded.scored_on if options.scores is None else "held-out drives"),
        recorded.source,
        recorded.limit,
        rigs,
    )


def _read_scores(path: Path) -> dict[str, float]:
    """mAP and NDS of the JSON of `bevcli validate` or `bevcli eval`. Raises InputError."""
    try:
        data = json.loads(read_text(path, 16 * MIB))
        scores = {"mAP": float(data["mean_ap"]), "NDS": float(data["nd_score"])}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path}: has no scores (expected the output of `bevcli validate --json`; {type(error).__name__}: {error})"
        ) from None
    if not all(map(math.isfinite, scores.values())):
        raise InputError(f"{path}: a score is not finite (found {scores})")
    return scores


def model_card(config: ModelConfig, facts: CardFacts, values: int) -> str:
    """The text of README.md. values: number of values in all tensors."""
    front = yaml.safe_dump(_front_matter(config, facts), sort_keys=False, allow_unicode=True, width=1000)
    paper, architecture = PAPERS.get(config.architecture, ""), config.architecture
    grid, (width, height) = config.bev_grid, config.image.size
    outputs = "3D boxes with velocities" + (", a map of the ground" if "segmentation" in config.heads else "")
    rows = {
        "architecture": f"[{architecture}]({paper})" if paper else architecture,
        "values": f"{values / 1e6:.1f} million",
        "input": f"images of {len(config.cameras)} cameras or as many as there are, scaled to {width} x {height}; "
        f"ego-motion; {config.rate_hz:g} frames a second",
        "BEV map": f"{grid.columns} x {grid.rows} cells, x {grid.x_range_m[0]:g} to {grid.x_range_m[1]:g} m, "
        f"y {grid.y_range_m[0]:g} to {grid.y_range_m[1]:g} m",
        "output": outputs,
        "classes": ", ".join(config.classes),
        "rigs of the training": facts.rigs,
        "trained on": ", ".join(facts.datasets),
        "first published": facts.source,
    }
    table = [f"| {title} | {text} |" for title, text in rows.items() if text]
    parts = [
        f"---\n{front}---\n",
        f"# {config.name}\n",
        f"Detects objects in bird's-eye view from several cameras. {facts.limit}".strip() + "\n",
        _USE,
        "## Model\n\n| | |\n|---|---|\n" + "\n".join(table) + "\n",
    ]
    if facts.scores:
        lines = [f"| {name} | {value:.3f} |" for name, value in facts.scores.items()]
        parts.append(f"## Scores\n\n{facts.scored_on}:\n\n| metric | value |\n|---|---|\n" + "\n".join(lines) + "\n")
    return "\n".join(parts)


_USE = """## Use

After `pip install 'bevcli[hub]'`, `bevcli run my_drive --model hf:OWNER/NAME` runs the model. OWNER/NAME is the name of
this repository; `@REVISION`, a branch, tag or commit, may follow it. In Python:

```python
import bevcli

model = bevcli.load_model("hf:OWNER/NAME")
```

`config.json` states the model and the SHA-256 of `model.safetensors`. bevcli checks it, and runs no code of them.
"""


def _front_matter(config: ModelConfig, facts: CardFacts) -> dict[str, Any]:
    licence = facts.licence.lower()
    named = {"license": licence}
    if not re.fullmatch(r"[a-z0-9.-]*", licence):  # no identifier of the Hub
        named = {"license": "other", "license_name": facts.licence}
    front: dict[str, Any] = {
        **named,
        "library_name": "bevcli",
        "pipeline_tag": "object-detection",
        "tags": ["bevcli", config.architecture.lower(), "3d-object-detection", "bird-eye-view", "multi-camera"],
        "datasets": list(facts.datasets),
    }
    if facts.scores:
        metrics = [{"type": name, "value": value} for name, value in facts.scores.items()]
        result = {
            "task": {"type": "object-detection", "name": "3D object detection from several cameras"},
            "dataset": {"type": facts.datasets[0] if facts.datasets else "other", "name": facts.scored_on},
            "metrics": metrics,
        }
        front |= {"metrics": list(facts.scores), "model-index": [{"name": config.name, "results": [result]}]}
    return {key: value for key, value in front.items() if value}
