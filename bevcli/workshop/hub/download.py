"""`hf:OWNER/NAME` and `hf:OWNER/NAME@REVISION`: a model of the Hugging Face Hub, by the package huggingface_hub.

The repository is a folder of `bevcli weights pack`: config.json and model.safetensors. The package keeps what it
downloads in its own cache, $HF_HOME or ~/.cache/huggingface, and reads its own settings: HF_ENDPOINT, HF_HUB_OFFLINE,
HF_TOKEN. A model that is there is used without a connection.
"""

import importlib
import os
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from bevcli._version import __version__
from bevcli.errors import BevcliError, InputError, WeightsError
from bevcli.parsing.documents import parse_json
from bevcli.parsing.files import MIB, hash_of_file, is_file_name, read_bytes
from bevcli.printing import one_line, reason_of
from bevcli.published import HubModel, Known
from bevcli.weights.fetch import LENGTH_DIGITS, MOST_BYTES, steady

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
        return client

    checking_client.checks_names = True  # type: ignore[attr-defined]
    hub.set_client_factory(checking_client)


def _check(answer: Any) -> None:
    """Raise WeightsError where a server sends too much or lets wait, or a name in its headers leads out of its folder.

    What it sends too slowly ends in a TimeoutError.
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
    """The contents of config.json.

    Attributes:
        library_name: "bevcli", by which the Hub tells programs apart.
        bevcli_version: that packed the model.
        format: FORMAT.
        weights: hash and size of model.safetensors.
        model: contents of the model file, as TOML would have them.
        limit: a sentence on what the weights are not for, which a run prints; "" for none.
    """

    library_name: str
    bevcli_version: str
    format: int
    weights: Known
    model: dict[str, Any]
    limit: str = ""


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
