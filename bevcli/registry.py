"""Models, formats of drives, engines and commands by name: bevcli's own, and those of other packages.

An installed package adds one by an entry point of a group (docs/extend.md). Nothing is imported before it is used.
"""

from functools import cache
from importlib import resources
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal

from bevcli.errors import BevcliError

Group = Literal["bevcli.models", "bevcli.sequences", "bevcli.engines", "bevcli.commands"]

# Group -> name -> "module:attribute".
OWN: dict[Group, dict[str, str]] = {
    "bevcli.models": {
        "BEVFormer": "bevcli.model.bevformer:BEVFormer",
        "BEVFormerV2": "bevcli.workshop.bevformer_v2:BEVFormerV2",
        "UniAD": "bevcli.workshop.uniad.uniad:UniAD",
        "VAD": "bevcli.workshop.vad.vad:VAD",
    },
    "bevcli.sequences": {
        "argoverse2": "bevcli.workshop.formats:Argoverse2Options",
        "dgp": "bevcli.workshop.formats:DgpScene",
        "kitti": "bevcli.workshop.formats:KittiDrive",
        "native": "bevcli.sequences.native:NativeFolder",
        "nuscenes": "bevcli.workshop.formats:NuScenesOptions",
        "ros": "bevcli.workshop.formats:BagOptions",
        "t4": "bevcli.workshop.formats:T4Dataset",
        "video": "bevcli.workshop.formats:VideoFile",
    },
    "bevcli.engines": {
        "onnxruntime": "bevcli.workshop.engines.engine:OnnxRuntimeEngine",
        "openvino": "bevcli.workshop.engines.engine:OpenVinoEngine",
    },
    "bevcli.commands": {
        "batch": "bevcli.workshop.batch.commands:batch",
        "bench": "bevcli.workshop.benchmark.commands:bench",
        "calibrate": "bevcli.workshop.calibration.commands:calibrate",
        "checks": "bevcli.workshop.checks.commands:checks",
        "convert": "bevcli.workshop.formats.commands:convert",
        "demo": "bevcli.workshop.synth.commands:demo",
        "eval": "bevcli.workshop.scores.commands:evaluate",
        "export": "bevcli.workshop.formats.commands:export",
        "export-onnx": "bevcli.workshop.engines.commands:export_onnx",
        "odometry": "bevcli.workshop.odometry.commands:odometry",
        "project-debug": "bevcli.cli.commands:project_debug",
        "quantize": "bevcli.workshop.engines.commands:quantize",
        "render": "bevcli.workshop.synth.commands:render",
        "reproduce": "bevcli.workshop.batch.commands:reproduce",
        "run": "bevcli.cli.run:run",
        "samples": "bevcli.cli.commands:samples",
        "stress": "bevcli.workshop.robustness.commands:stress",
        "train": "bevcli.workshop.training.commands:train",
        "validate": "bevcli.workshop.training.commands:validate",
        "viz": "bevcli.cli.commands:viz",
        "weights": "bevcli.workshop.weights.commands:weights_app",
    },
}


@cache
def installed() -> Any:
    """The entry points of all installed packages, read once; Python 3.11 has another type for them than 3.12."""
    return entry_points()


@cache
def entries(group: Group) -> dict[str, EntryPoint]:
    """The entries of a group by name, in the order of their names. Raises BevcliError where two have the same name."""
    by_name = {name: EntryPoint(name, value, group) for name, value in OWN[group].items()}
    for entry in installed().select(group=group):
        if entry.value.startswith("bevcli."):  # of an earlier version, which an editable install may still list
            continue
        other = by_name.setdefault(entry.name, entry)
        if other.value != entry.value:
            raise BevcliError(
                f'entry point {group}: two packages register "{entry.name}": {other.value} and {entry.value}: '
                "uninstall one of them"
            )
    return dict(sorted(by_name.items()))


@cache
def load(group: Group, name: str) -> Any:
    """The object of an entry. Raises BevcliError for an unknown name, or for one that cannot be imported."""
    registered = entries(group)
    if name not in registered:
        raise BevcliError(f'entry point {group}: "{name}" is unknown (expected {", ".join(registered)})')
    try:
        return registered[name].load()
    except Exception as error:  # whatever a package of somebody else does
        raise BevcliError(
            f"entry point {group}: {name} = {registered[name].value} cannot be imported: {error}"
        ) from error


def is_of_hub(name: str) -> bool:
    """True for the name of a model of the Hugging Face Hub, "hf:OWNER/NAME"."""
    return name.startswith("hf:")


def known_models() -> tuple[str, ...]:
    """The names of the models whose TOML files come with the package."""
    files = resources.files("bevcli").joinpath("configs").iterdir()
    return tuple(sorted(Path(file.name).stem for file in files if file.name.endswith(".toml")))
