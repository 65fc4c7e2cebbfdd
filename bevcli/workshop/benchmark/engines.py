"""`compare_engines`: PyTorch and the engines side by side, alternating in one process."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain, product
from statistics import median
from typing import Any

import torch
from torch import Tensor

from bevcli.errors import BevcliError
from bevcli.inference.load import Model, installed_engines
from bevcli.inference.machine import describe_machine
from bevcli.inference.options import TORCH
from bevcli.model.config import ModelConfig
from bevcli.workshop.benchmark.made_up import MadeUpDrive, made_up_model
from bevcli.workshop.benchmark.measure import WARM_UP_FRAMES
from bevcli.workshop.benchmark.versions import Version, difference, largest_differences
from bevcli.workshop.engines.export_cache import CALIBRATION_FRAMES

CPU = torch.device("cpu")


@dataclass(frozen=True)
class EngineRow:
    """One engine in one precision.

    Attributes:
        engine: its name.
        precision: of the image features.
        seconds: of each frame.
        largest_m: largest distance of a box centre from that of PyTorch in float32, over all object queries.
        near: share of them that are within 0.1 m, 0 to 1.
        score: largest difference of scores.
        problem: why it could not be measured; "" if it was.
    """

    engine: str
    precision: str
    seconds: tuple[float, ...] = ()
    largest_m: float = 0.0
    near: float = 1.0
    score: float = 0.0
    problem: str = ""


@dataclass(frozen=True)
class EngineTable:
    """All engines of a model on this machine. rows: PyTorch in float32 is the first one."""

    model: str
    machine: str
    rows: tuple[EngineRow, ...]

    def as_data(self) -> dict[str, Any]:
        """The table for JSON."""
        return {"model": self.model, "machine": self.machine, "engines": [vars(row) for row in self.rows]}

    def text(self) -> str:
        """The table."""
        first = median(self.rows[0].seconds)
        heads = ("engine", "frame, ms", "fastest to slowest", "of torch fp32", "in 0.1 m", "largest, m", "scores")
        lines = [f"{self.model}, {self.machine}, alternating frames, made-up weights", "", _line(*heads)]
        for row in self.rows:
            name = f"{row.engine} {row.precision}"
            if row.problem:
                lines.append(f"{name:<18}{row.problem}")
                continue
            middle, span = median(row.seconds), f"{1000 * min(row.seconds):.1f} to {1000 * max(row.seconds):.1f}"
            cells = (f"{1000 * middle:.1f}", span, f"{middle / first:.2f}", f"{row.near:.1%}")
            lines.append(_line(name, *cells, f"{row.largest_m:.2g}", f"{row.score:.2g}"))
        return "\n".join(lines)


def compare_engines(config: ModelConfig, frames: int, report: Callable[[str], None]) -> EngineTable:
    """Time a step of PyTorch and of every installed engine on the same frames, in turn, and compare their boxes.

    Nothing else should run on the machine.

    Args:
        config: of the model, which gets made-up weights.
        frames: number of timed frames.
        report: see `Model.in_engine`.
    """
    versions: dict[tuple[str, Any], Version] = {}
    failed: list[EngineRow] = []
    network, drive = made_up_model(config), MadeUpDrive(CALIBRATION_FRAMES)
    pairs: Iterable[tuple[str, Any]] = chain(
        product([TORCH], ("fp32", "bf16")), product(installed_engines(), ("fp32", "int8"))
    )
    for engine, precision in pairs:
        model = Model(network, engine=engine, precision=precision)
        try:
            model = model.in_engine(drive.rig, drive, report=report)
        except BevcliError as error:
            failed.append(EngineRow(engine, precision, problem=str(error)))
        else:
            versions[engine, precision] = Version(model.prepared, CPU, takes_pixels=model.is_exported)
    first = config.past_frames
    drive = MadeUpDrive(first + WARM_UP_FRAMES + frames)
    preprocessors = {name: version.runner.preprocessor() for name, version in versions.items()}
    differences: dict[tuple[str, Any], list[tuple[Tensor, Tensor]]] = {name: [] for name in versions}
    for index in range(first, len(drive.stamps)):
        frame = drive.load(index)
        for name, version in versions.items():
            version.step(preprocessors[name](frame))
            if index == first:
                version.fill_past(drive)
            if index >= first + WARM_UP_FRAMES:
                differences[name].append(difference(version.queries, versions[TORCH, "fp32"].queries))
    rows = [
        EngineRow(*name, tuple(version.seconds[WARM_UP_FRAMES:]), *largest_differences(differences[name]))
        for name, version in versions.items()
    ]
    return EngineTable(config.name, describe_machine(CPU), (*rows, *failed))


def _line(name: str, *cells: str) -> str:
    return f"{name:<18}" + "".join(f"{cell:>20}" if "to" in cell.split() else f"{cell:>14}" for cell in cells)
