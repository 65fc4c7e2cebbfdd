"""Job: what every drive of a batch is run with."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bevcli import __version__
from bevcli.model.prepared import Precision
from bevcli.pipeline.model_loading import Model, load_model
from bevcli.pipeline.run import RunOptions

# Options of `open_sequence` that apply to nuScenes roots only.
NUSCENES_OPTIONS = ("version", "sweeps")


@dataclass(frozen=True)
class Job:
    """What every drive of a batch is run with. On a cluster, the paths in it must exist on every machine.

    Attributes:
        out: path or URL of the batch's folder.
        model, weights, untrained, device, precision: of `load_model`.
        reading: options of `open_sequence`, without `scene`.
        run: options of `run_into_folder`.
        embed: whether a vector per frame is written.
        evaluate: whether drives with ground truth are scored.
        retries: further attempts after a drive has failed.
    """

    out: str
    model: str | None = None
    weights: Path | None = None
    untrained: bool = False
    device: str = "auto"
    precision: Precision | None = None
    reading: Mapping[str, Any] = field(default_factory=dict)
    run: RunOptions = field(default_factory=RunOptions)
    embed: bool = False
    evaluate: bool = False
    retries: int = 2

    def load_model(self, device: str | None = None) -> Model:
        """The model with its weights. device: another one than the job's. Raises BevcliError."""
        device = self.device if device is None else device
        return load_model(self.model, self.weights, device=device, precision=self.precision, untrained=self.untrained)

    def reading_of(self, scene: str | None) -> dict[str, Any]:
        """The options of `open_sequence` for a drive; scene: of a nuScenes root, None for other inputs."""
        options = {name: value for name, value in self.reading.items() if scene or name not in NUSCENES_OPTIONS}
        return {**options, "scene": scene}

    def hash(self, model: Model) -> str:
        """SHA-256 of what the results of a drive depend on, its input excepted. model: of `load_model`, any device."""
        facts = {
            "version": __version__,
            "model": model.config_hash,
            "weights": model.weights_hash,
            "device": self.device,
            "precision": self.precision,
            "reading": {name: _fact(value) for name, value in sorted(self.reading.items())},
            "run": {name: _fact(value) for name, value in sorted(vars(self.run).items())},
            "embed": self.embed,
            "evaluate": self.evaluate,
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _fact(value: object) -> str:
    """A value as text; of a file, its contents count and not its name."""
    if isinstance(value, Path) and value.is_file():
        return hashlib.sha256(value.read_bytes()).hexdigest()
    return repr(value)
