"""Models of the Hugging Face Hub: `hf:OWNER/NAME` and `hf:OWNER/NAME@REVISION`, and folders to share.

The repository is a folder of `pack_model`: config.json, model.safetensors and README.md, a model card with the front
matter that the Hub reads. The package huggingface_hub keeps what it downloads in its own cache, $HF_HOME or
~/.cache/huggingface, and reads its own settings: HF_ENDPOINT, HF_HUB_OFFLINE, HF_TOKEN. A model that is there is used
without a connection.
"""

import hashlib
import importlib
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import msgspec
import safetensors.torch
import yaml

from bevcli._version import __version__
from bevcli.checkpoints import Checkpoint, bundled_weights, expected_state, read_checkpoint, require_fit
from bevcli.config import TRAINING, as_table, config_of_table, read_model_file
from bevcli.errors import BevcliError, InputError, OutputError, WeightsError
from bevcli.inference.load import tracker_of_table, weights_file
from bevcli.model.config import ModelConfig
from bevcli.options import gather
from bevcli.parsing.documents import parse_json
from bevcli.parsing.files import MIB, hash_of_file, is_file_name, read_bytes, read_text
from bevcli.printing import one_line, reason_of
from bevcli.published import HubModel, Known, all_weights
from bevcli.workshop.weights import PackOptions
from bevcli.workshop.weights.fetch import LENGTH_DIGITS, MOST_BYTES, answered, steady
from bevcli.writing import write_whole

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"
FORMAT = 1  # of config.json; increase it when an earlier bevcli cannot read it
_NAME = re.compile(r"hf:([\w.-]+/[\w.-]+)(?:@([\w.][\w./-]*))?")
NAMES = ("ETag", "X-Linked-Etag", "X-Repo-Commit", "X-Xet-Hash")  # headers of which huggingface_hub makes paths
COMMIT_DIGITS = 12
TELEMETRY = "HF_HUB_DISABLE_TELEMETRY"


def open_model(name: str, *, fetch: bool = False) -> HubModel:
    """A model of the Hub, downloaded if its revision is not in the cache; or one in a folder of `bevcli weights pack`.

    Args:
        name: "hf:OWNER/NAME", "hf:OWNER/NAME@REVISION" (a branch, tag or commit), or "hf:" and a path that begins with
            "." or "/".
        fetch: ask the Hub for the newest commit of the branch, also where the cache has one.

    Raises:
        WeightsError: the name is of another form, there is no such model, it cannot be downloaded, or it is damaged.
        BevcliError: huggingface_hub is not installed.
    """
    folder_name = name.partition(":")[2]
    if folder_name.startswith((".", "/", "~")):
        return read_folder(Path(folder_name).expanduser(), f"model in {folder_name}")
    match = _NAME.fullmatch(name)
    if match is None or not all(map(is_file_name, (match[2] or "main").split("/"))):
        raise WeightsError(
            f"`model={name}` (`--model`): is no model of the Hugging Face Hub (expected hf:OWNER/NAME, "
            "hf:OWNER/NAME@REVISION or hf:./FOLDER)"
        )
    folder = _snapshot(match[1], match[2], fetch)
    branch = f" ({match[2] or 'main'})" if match[2] != folder.name else ""
    source = f"model hf:{match[1]}, commit {folder.name[:COMMIT_DIGITS]}{branch}"
    return read_folder(folder, source, f"remove {folder.parents[1]}, and it is downloaded again")


def _snapshot(repository: str, revision: str | None, fetch: bool) -> Path:
    """The folder of a commit in the cache, with both files. Raises WeightsError."""
    hub = import_hub(f"hf:{repository}")
    errors = hub.errors

    def get(file: str, revision: str | None) -> Path:
        version = {"library_name": "bevcli", "library_version": __version__}
        return Path(hub.hf_hub_download(repository, file, revision=revision, **version))

    try:
        if not fetch:  # huggingface_hub has another function that looks into the cache, but it connects for its headers
            cached = [hub.try_to_load_from_cache(repository, file, revision=revision) for file in (CONFIG, WEIGHTS)]
            if all(isinstance(path, str) for path in cached):
                return Path(cached[0]).parent
        if fetch:  # a download would take what is in the cache if the Hub gives no answer
            hub.get_hf_file_metadata(hub.hf_hub_url(repository, CONFIG, revision=revision))
        folder = get(CONFIG, revision).parent
        get(WEIGHTS, folder.name)  # of the same commit
    except Exception as error:  # of huggingface_hub, or of what downloads for it
        model_name = f"hf:{repository}" + (f"@{revision}" if revision else "")
        cause = f"{reason_of(error.__cause__ or error):.300}"
        reasons: dict[tuple[type[Exception], ...], str] = {  # the first one that fits
            (errors.RevisionNotFoundError,): f"the repository has no branch, tag or commit {revision}",
            (errors.RepositoryNotFoundError,): "there is no such model, or it is private: check the name, or run "
            "`hf auth login`",
            (errors.LocalEntryNotFoundError, errors.OfflineModeIsEnabled): "is not in the cache, and cannot be "
            f"downloaded: check the network, HF_ENDPOINT and HF_HUB_OFFLINE ({cause})",
            (errors.HFValidationError,): f"is no name of a model of the Hub ({cause})",
            (errors.EntryNotFoundError,): f"is no model of bevcli: it lacks {CONFIG} or {WEIGHTS}",
        }
        reason = next((text for kinds, text in reasons.items() if isinstance(error, kinds)), None)
        raise WeightsError(f"{model_name}: {reason or f'cannot be downloaded ({cause})'}") from None
    return folder


def import_hub(what: str = "hf:OWNER/NAME") -> Any:
    """The package huggingface_hub, without its telemetry, a setting that it reads when it is imported.

    what: needs it, for the error. Raises BevcliError where it is not installed.
    """
    before = os.environ.get(TELEMETRY)
    os.environ.setdefault(TELEMETRY, "1")
    try:
        for module in ("constants", "errors"):
            importlib.import_module(f"huggingface_hub.{module}")
        hub = importlib.import_module("huggingface_hub")
        _check_answers(hub)
        return hub
    except (ImportError, AttributeError):
        raise BevcliError(f"{what}: needs huggingface_hub: run pip install 'bevcli[hub]'") from None
    finally:
        if before is None:
            del os.environ[TELEMETRY]


def _check_answers(hub: Any) -> None:
    """Have huggingface_hub check every answer of a server: it makes paths in its cache of names in the headers."""
    http = importlib.import_module("huggingface_hub.utils._http")
    make_client = http._GLOBAL_CLIENT_FACTORY  # the user's own, where one was set
    if getattr(make_client, "checks_names", False):
        return

    def checking_client() -> Any:
        client = make_client()
        client.event_hooks["response"].append(_check)
        client.send = partial(answered, client.send)
        return client

    checking_client.checks_names = True  # type: ignore[attr-defined]
    hub.set_client_factory(checking_client)


def _check(answer: Any) -> None:
    """Raise WeightsError where a server sends too much or lets wait, or a name in its headers leads out of its folder.

    What it sends too slowly ends in a TimeoutError, as headers that do not come (`answered`).
    """
    host, headers = answer.request.url.host, answer.headers
    if answer.status_code == 429:  # huggingface_hub would wait as long as it is told
        wait = headers.get("Retry-After", "")
        raise WeightsError(
            f"{host}: too many requests: try again {f'in {wait:.20} s' if wait.isdecimal() else 'later'}"
        )
    sizes = (headers.get(name, "") for name in ("Content-Length", "X-Linked-Size"))
    if any(size.isdecimal() and int(size[:LENGTH_DIGITS]) > MOST_BYTES for size in sizes):
        raise WeightsError(f"{host}: the server sends more than {MOST_BYTES:,} bytes: refused")
    parts = answer.iter_raw
    answer.iter_raw = lambda chunk_size=None: steady(parts(chunk_size))
    for header in NAMES if answer.request.method == "HEAD" else ():  # in other answers they name nothing
        name = headers.get(header, "").removeprefix("W/").strip('"')
        if name and not is_file_name(name):
            raise WeightsError(f"{host}: the server's {header} is no name of a file ({one_line(name, 60)}): refused")


class PackedConfig(msgspec.Struct, frozen=True, kw_only=True):
    """The contents of config.json."""

    library_name: str  # "bevcli", by which the Hub tells programs apart
    bevcli_version: str  # that packed the model
    format: int  # FORMAT
    weights: Known  # hash and size of model.safetensors
    model: dict[str, Any]  # contents of the model file, as TOML would have them
    limit: str = ""  # a sentence on what the weights are not for, which a run prints; "" for none


def read_folder(folder: Path, source: str, mend: str = "pack the model anew") -> HubModel:
    """The model in a folder of `pack_model`, whose weights are checked against the hash in config.json.

    source: for texts. mend: what to do about damaged weights. Raises WeightsError.
    """
    path = folder / CONFIG
    content = read_bytes(path, MIB, error=WeightsError)
    try:
        config = msgspec.convert(parse_json(content, path), PackedConfig)
    except (msgspec.MsgspecError, InputError) as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise WeightsError(f"{path}: is not of `bevcli weights pack` ({reason}): {mend}") from None
    if config.library_name != "bevcli" or config.format != FORMAT:
        identity = f"library {config.library_name:.60}, format {config.format}"
        raise WeightsError(
            f"{path}: this bevcli cannot read it (expected library bevcli, format {FORMAT}; found {identity})"
        )
    classes = config.model.get("class_settings", {})
    if any("mesh" in settings for settings in classes.values() if isinstance(settings, dict)):
        raise WeightsError(f"{path}: names a mesh, a file of this machine: refused (`bevcli weights pack` writes none)")
    weights = folder / WEIGHTS
    try:
        stat = weights.stat()
    except OSError as error:
        raise WeightsError(f"{weights}: {error.strerror} (config.json is there)") from None
    weights_here = Known(_sha256(weights, stat.st_mtime_ns, stat.st_size), stat.st_size)
    if weights_here != config.weights:
        raise WeightsError(
            f"{weights}: has the SHA-256 {weights_here.sha256} and {weights_here.bytes:,} bytes (expected "
            f"{config.weights.sha256} and {config.weights.bytes:,}, as config.json states): {mend}"
        )
    return HubModel(config.model, path, weights, f"{source}: {config.limit}" if config.limit else source)


@lru_cache(maxsize=8)
def _sha256(path: Path, *_changes_with_it: int) -> str:
    return hash_of_file(path)


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
        {"mAP": 0.562, "NDS": 0.639},
        f"40 {RENDERED}",
        "The weights were trained on rendered streets (`bevcli render`) and do not work on real images.",
    ),
    "photographs": (
        {"mAP": 0.561, "NDS": 0.596},
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
    write_whole(out / WEIGHTS, weights, parents=True)  # first: if the disk is full, nothing is left
    for target, text in zip((out / CONFIG, out / CARD), texts, strict=True):
        write_whole(target, text.encode())
    notes = list(card_facts.missing)
    if any(settings.mesh for settings in config.class_settings.values()):
        notes.append("meshes of classes are files of this machine: the folder has none")
    return tuple(targets), tuple(notes)


@dataclass(frozen=True)
class CardFacts:
    """What a card states beside the model's configuration."""

    licence: str = ""  # of the weights; "" where none is known
    datasets: tuple[str, ...] = ()  # that the weights were trained on
    scores: Mapping[str, float] | None = None  # by name
    scored_on: str = ""  # the data of the scores
    source: str = ""  # where the weights were published first; "" if that is not known
    limit: str = ""  # a sentence on what the weights are not for; "" for none
    rigs: str = ""  # the rigs of the training, as the metadata of the weights states them; "" if it does not

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
