"""A model as the Hugging Face Hub shares one: a folder with config.json and model.safetensors."""

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from bevcli.errors import WeightsError
from bevcli.parsing.files import MIB, read_bytes
from bevcli.published import HubModel, Known

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"
FORMAT = 1  # of config.json; increase it when an earlier bevcli cannot read it


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
    try:
        config = msgspec.json.decode(read_bytes(path, MIB, error=WeightsError), type=PackedConfig)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: is not of `bevcli weights pack` ({error})") from None
    if config.library_name != "bevcli" or config.format != FORMAT:
        stated = f"library {config.library_name:.60}, format {config.format}"
        raise WeightsError(
            f"{path}: this bevcli cannot read it (expected library bevcli, format {FORMAT}; found {stated})"
        )
    classes = config.model.get("class_settings", {})
    if any("mesh" in own for own in classes.values() if isinstance(own, dict)):
        raise WeightsError(f"{path}: names a mesh, a file of this machine: refused (`bevcli weights pack` writes none)")
    weights = folder / WEIGHTS
    try:
        stat = weights.stat()
    except OSError as error:
        raise WeightsError(f"{weights}: {error.strerror} (config.json is there)") from None
    found = Known(_sha256(weights, stat.st_mtime_ns, stat.st_size), stat.st_size)
    if found != config.weights:
        raise WeightsError(
            f"{weights}: has the SHA-256 {found.sha256} and {found.bytes:,} bytes (expected {config.weights.sha256} "
            f"and {config.weights.bytes:,}, as config.json states): {mend}"
        )
    return HubModel(config.model, path, weights, f"{source}: {config.limit}" if config.limit else source)


@lru_cache(maxsize=8)
def _sha256(path: Path, *_changes_with_it: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
