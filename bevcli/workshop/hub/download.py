"""`hf:OWNER/NAME` and `hf:OWNER/NAME@REVISION`: a model of the Hugging Face Hub, by the package huggingface_hub.

That package keeps what it downloads in its own cache, $HF_HOME or ~/.cache/huggingface, and reads its own settings:
HF_ENDPOINT, HF_HUB_OFFLINE, HF_TOKEN. A model that is there is used without a connection.
"""

import importlib
import os
import re
from pathlib import Path
from typing import Any

from bevcli._version import __version__
from bevcli.errors import BevcliError, WeightsError
from bevcli.printing import reason_of
from bevcli.published import HubModel
from bevcli.workshop.hub.folder import CONFIG, WEIGHTS, read_folder

_NAME = re.compile(r"hf:([\w.-]+/[\w.-]+)(?:@([\w.][\w./-]*))?")
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
    place = name.partition(":")[2]
    if place.startswith((".", "/", "~")):
        return read_folder(Path(place).expanduser(), f"model in {place}")
    match = _NAME.fullmatch(name)
    if match is None:
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
    if not fetch:  # huggingface_hub has another function that looks into the cache, but it connects for its headers
        cached = [hub.try_to_load_from_cache(repository, file, revision=revision) for file in (CONFIG, WEIGHTS)]
        if all(isinstance(path, str) for path in cached):
            return Path(cached[0]).parent

    def get(file: str, revision: str | None) -> Path:
        version = {"library_name": "bevcli", "library_version": __version__}
        return Path(hub.hf_hub_download(repository, file, revision=revision, **version))

    try:
        if fetch:  # a download would take what is in the cache if the Hub gives no answer
            hub.get_hf_file_metadata(hub.hf_hub_url(repository, CONFIG, revision=revision))
        folder = get(CONFIG, revision).parent
        get(WEIGHTS, folder.name)  # of the same commit
    except Exception as error:  # of huggingface_hub, or of what downloads for it
        where = f"hf:{repository}" + (f"@{revision}" if revision else "")
        cause = f"{reason_of(error.__cause__ or error):.300}"
        reasons: dict[tuple[type[Exception], ...], str] = {  # the first one that fits
            (errors.RevisionNotFoundError,): f"the repository has no branch, tag or commit {revision}",
            (errors.RepositoryNotFoundError,): "there is no such model, or it is private: check the name, or run "
            "`hf auth login`",
            (errors.LocalEntryNotFoundError, errors.OfflineModeIsEnabled): "is not in the cache, and cannot be "
            f"downloaded: check the network, HF_ENDPOINT and HF_HUB_OFFLINE ({cause})",
            (errors.EntryNotFoundError,): f"is no model of bevcli: it lacks {CONFIG} or {WEIGHTS}",
        }
        reason = next((text for kinds, text in reasons.items() if isinstance(error, kinds)), None)
        raise WeightsError(f"{where}: {reason or f'cannot be downloaded ({cause})'}") from None
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
        return importlib.import_module("huggingface_hub")
    except ImportError:
        raise BevcliError(f"{what}: needs huggingface_hub: run pip install 'bevcli[hub]'") from None
    finally:
        if before is None:
            del os.environ[TELEMETRY]
