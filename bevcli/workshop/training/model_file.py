"""A new model file for a data set, with what its training costs on this machine."""

import contextlib
import json
import re
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from bevcli.config import TRAINING, load_config
from bevcli.errors import InputError, OutputError
from bevcli.frame import Sequence
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.inference.machine import peak_memory
from bevcli.printing import counted, duration
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import SequenceOptions
from bevcli.workshop.synth.drives import read_split
from bevcli.workshop.synth.options import DriveOptions
from bevcli.workshop.training.job import TrainingConfig, TrainingJob, prepare_training
from bevcli.workshop.training.options import Preset, TrainOptions
from bevcli.workshop.training.presets import INSIDE_PERCENT, PRESETS, DataFacts, look_at, model_table
from bevcli.workshop.training.trainer import Trainer
from bevcli.writing import write_whole

LONGEST_S = 10.0  # of the measurement of the cost; an update that takes longer is still finished
MEMORY_SHARE = 0.7  # of a GPU's memory, that a batch may take
LARGEST_BATCH = 32  # clips; more keep no GPU busier


def write_model_file(
    path: Path, data: DriveOptions, preset: Preset, device: torch.device, longest_s: float = LONGEST_S
) -> list[str]:
    """Write a model file for the drives, from a preset, and return its first lines: the facts and the cost.

    The file is trained for some seconds before it is written, so that it is known to work.

    Args:
        path: the file, which ends in .toml and does not exist.
        data: the drives, folders.
        device: to measure on.
        longest_s: time of the measurement, seconds.

    Raises BevcliError where the drives, or the path, are wrong; nothing is written then.
    """
    if path.suffix != ".toml" or path.exists():
        raise OutputError(f"{path}: " + ("exists already" if path.exists() else "expected a name that ends in .toml"))
    name = re.sub(r"[^\w. +-]", "-", path.stem).lstrip("-. +")[:100] or "model"
    facts = look_at(_open_drives(data), load_config(PRESETS[preset][0]).bev_frame)
    table = model_table(name, preset, facts)
    lines = [f"Model {name} for {counted(len(facts.drives), 'drives')}, preset {preset}.", *_facts_lines(facts, table)]
    cost = _cost_of(table, device, data, longest_s)
    if device.type == "cuda":
        clips, card_bytes = cost.config.clips, torch.cuda.get_device_properties(device).total_memory
        most = min(LARGEST_BATCH, facts.frames // clips.frames)
        batch = fitting_batch(clips.batch, cost.memory_bytes, card_bytes, most)
        if batch > clips.batch:
            table[TRAINING]["clips"]["batch"] = batch
            cost = _cost_of(table, device, data, longest_s)
    lines += [f"Cost, measured on this machine: {cost}.", f"In this file {cost.config.clips}."]
    text = "\n".join([*(f"# {line}" for line in lines), _toml(table)])
    write_whole(path, text.encode(), parents=True)
    return lines


def _cost_of(table: Mapping[str, Any], device: torch.device, data: DriveOptions, longest_s: float) -> "Cost":
    """The cost of the training of a model's file with these contents."""
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / "model.toml"
        trial.write_text(_toml(table), encoding="utf-8")
        job = prepare_training(str(trial), device, data, TrainOptions(out=Path(folder) / "out"))
        return measure_cost(job, longest_s)


def fitting_batch(batch: int, used_bytes: int, card_bytes: int, most: int) -> int:
    """The clips of a batch that fill a card, at least `batch`, which used so much memory, and else at most `most`.

    The memory of a clip is overestimated by its share of the memory that does not depend on the batch.
    """
    return max(batch, min(most, int(MEMORY_SHARE * card_bytes * batch / used_bytes)))


def _open_drives(data: DriveOptions) -> list[Sequence]:
    """All drives, at their own frame rate. Raises InputError."""
    if data.rendered is not None:
        raise InputError("`init` needs drives in folders (`data` or `split`): rendered drives are trained with demo")
    split = None if data.split is None else read_split(data.split)
    folders = data.data if split is None else (*split.train, *split.validate)
    if not folders or (split is not None and data.data):
        raise InputError("`init`: choose the drives: give either `data=DIR` (repeatable) or `split=FILE`")
    classes = tuple(dict.fromkeys([*NUSCENES_CLASSES, *data.class_map.values()]))
    options = SequenceOptions(data.class_map, rate_hz="all", classes=classes)
    return [open_sequence(folder, options) for folder in folders]


def _facts_lines(facts: DataFacts, table: Mapping[str, Any]) -> Iterator[str]:
    """The facts that the settings of the file follow from."""
    named = ", ".join(f"{name} {facts.class_counts[name]}" for name in table["classes"])
    yield f"Boxes in {counted(facts.frames, 'frames')}: {named}."
    alike = ", ".join(f"{name} like {settings['like']}" for name, settings in table.get("class_settings", {}).items())
    if alike:
        yield f"Own classes, by the sizes of their boxes: {alike}; [class_settings] changes it."
    counts = sorted({len(rig.cameras) for rig in facts.rigs})
    number = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    sizes = [" x ".join(map(str, size)) for size in (facts.image_size, table["image"]["size"])]
    yield f"Cameras: {number}, images of {sizes[0]}, used at {sizes[1]}."
    yield f"Frames per second: {facts.rate_hz:.3g}, used at {table['rate_hz']:g}."
    grid = table["bev_grid"]
    half = grid["x_range_m"][1]
    cells = f"{grid['columns']} x {grid['rows']} BEV cells of {2 * half / grid['columns']:.2f} m"
    yield f"{INSIDE_PERCENT:g} % of the boxes are within {facts.reach_m:.1f} m ahead and to the sides: {cells}."
    if 0 < facts.map_reach_m < half:
        yield f"Maps reach {facts.map_reach_m:g} m only, less than the grid: the model has no segmentation head."


def _toml(table: Mapping[str, Any], prefix: str = "") -> str:
    """A table as TOML: its values first, then the tables in it."""
    lines = [f"{_key(key)} = {_json(value)}" for key, value in table.items() if not isinstance(value, Mapping)]
    for key, value in table.items():
        if isinstance(value, Mapping):
            name = f"{prefix}{_key(key)}"
            lines += ["", f"[{name}]", _toml(value, f"{name}.").rstrip("\n")]
    return "\n".join(lines) + "\n"


def _json(value: Any) -> str:
    """A text, number, truth value or list in TOML, which writes these as JSON does."""
    return json.dumps(value, ensure_ascii=False)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _json(name)


class _EnoughMeasured(Exception):
    """Ends the training that is measured."""


@dataclass(frozen=True)
class Cost:
    """The cost of a training.

    Attributes:
        config: its settings.
        machine: the device, in words.
        update_s: time of an update of the weights, while another thread reads the next batch.
        reading_s: time until the first batch was read, at most; 0 where processes read, for which `update_s` waits.
        memory_bytes: the largest memory, of the process or of a GPU.
    """

    config: TrainingConfig
    machine: str
    update_s: float
    reading_s: float
    memory_bytes: int

    @property
    def step_s(self) -> float:
        """Time of a step: of its updates, or of reading its batches where this takes longer."""
        clips = self.config.clips
        return max(clips.updates * self.update_s, clips.in_turn * self.reading_s)

    def __str__(self) -> str:
        """The cost on one line."""
        steps, updates = self.config.steps, self.config.clips.updates
        step = f"{self.update_s:.2g} s an update"
        if updates > 1:
            step += f", {duration(self.step_s)} a step of {updates}"
        whole = f"{duration(steps * self.step_s)} for {counted(steps, 'steps')} without scoring"
        return f"{self.machine}: {step}, {whole}; memory {self.memory_bytes / 1e9:.1f} GB"


def measure_cost(job: TrainingJob, longest_s: float = LONGEST_S) -> Cost:
    """Train for some seconds, at least one update. Changes the job's model; writes curves into its folder.

    Raises BevcliError as the training would.
    """
    times = [time.perf_counter()]

    def after_update(loss: float) -> None:
        times.append(time.perf_counter())
        if times[-1] - times[0] >= longest_s:
            raise _EnoughMeasured

    config = replace(job.config, steps=10**6, evaluate_every=10**6, checkpoint_every=10**6)
    config = replace(config, clips=replace(config.clips, in_turn=1, short_share=0.0))
    machine = f"{job.device.type}, {torch.get_num_threads()} threads"
    if job.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(job.device)
        machine = torch.cuda.get_device_name(job.device)
    with contextlib.suppress(_EnoughMeasured):
        Trainer(replace(job, config=config)).run(after_update=after_update)
    spans = [later - earlier for earlier, later in pairwise(times)]
    update_s = sum(spans[1:]) / len(spans[1:]) if len(spans) > 1 else spans[0]
    reading_s = max(spans[0] - update_s, 0.0) if job.loaders == 1 else 0.0  # processes take seconds to start
    return Cost(job.config, machine, update_s, reading_s, peak_memory(job.device))
