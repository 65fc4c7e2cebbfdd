"""Trains the model photographs in a stated time, for a GPU that is there for minutes only.

    python tests/tools/photographs.py OUT [--render-s 120] [--train-s 240] [--seeds 20000:20600] \
        [--material FOLDER] [--set KEY=VALUE]...

It goes on from the weights in the package. For drives that show photographic skies, textures and models of public
packages: python tests/tools/material.py material

1. All processor cores render drives with varied looks into OUT/drives until their time is over. A call that is stopped
   meanwhile goes on with its drives the next time.
2. The whole model but the detector learns from the drives, at a learning rate that falls with the time.

Weights: OUT/weights.safetensors, and OUT/weights_90.safetensors and so on after that many seconds. No network is used.
docs/training.md has what it gave.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path

import torch

from bevcli.config import TRAINING, as_toml, load_config, load_table, read_model_file
from bevcli.inference.load import choose_device
from bevcli.printing import say
from bevcli.workshop.synth import DriveOptions, parse_seeds
from bevcli.workshop.synth.drives import RenderedDrives
from bevcli.workshop.training import TrainOptions
from bevcli.workshop.training.job import OptimizerConfig, TrainingConfig, prepare_training
from bevcli.workshop.training.trainer import Trainer, save_weights

CHANGES = {
    "training.clips": {"batch": 24, "in_turn": 1},
    "training.optimizer": {"learning_rate": 6e-4, "average": 0.997},
}  # of photographs.toml
SAVE_S = 90.0


@dataclass(frozen=True)
class TimedOptimizer(OptimizerConfig):
    """A learning rate that falls as a cosine until `end_s`.

    Attributes:
        end_s: by time.perf_counter.
        begun_s: of the first update, appended by it.
    """

    end_s: float = 0.0
    begun_s: list[float] = field(default_factory=list)

    def learning_rate_at(self, step: int, steps: int) -> float:
        """The rate of the next step."""
        now = time.perf_counter()
        if not self.begun_s:
            self.begun_s.append(now)
        done = min(1.0, (now - self.begun_s[0]) / max(self.end_s - self.begun_s[0], 1.0))
        warm_up = min(1.0, 0.02 + done / 0.03)
        return self.learning_rate * warm_up * (0.01 + 0.99 * (1 + math.cos(math.pi * done)) / 2)


def main() -> int:
    """Renders, then trains."""
    parser = argparse.ArgumentParser(description="Train the model photographs in a stated time.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--weights", type=Path, default=Path("photographs"), help="to start from")
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds("20000:20600"))
    parser.add_argument("--render-s", type=float, default=120.0)
    parser.add_argument("--train-s", type=float, default=240.0)
    parser.add_argument("--material", type=Path, help="folder that material.py wrote")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the training table")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    model = model_file(asked.out / "photographs.toml", asked.material)
    seeds = rendered(model, asked.seeds, asked.out / "drives", asked.render_s)
    if len(seeds) < 2:
        say(f"error: found {len(seeds)} drives in {asked.out / 'drives'} (expected 2 or more): use a larger --render-s")
        return 1
    train(model, seeds, asked)
    return 0


def model_file(path: Path, material: Path | None = None) -> Path:
    """Write the model's file: photographs.toml with CHANGES and the material of drives."""
    table = read_model_file("photographs")[0]
    for name, changes in CHANGES.items():
        part = table
        for each in name.split("."):
            part = part[each]
        part.update(changes)
    if material is not None:
        table["training"]["rigs"]["material"] = str(material.resolve())
    path.write_text(as_toml(table))
    return path


def drives_of(model: Path, seeds: tuple[int, ...], cache: Path) -> RenderedDrives:
    """The drives of seeds."""
    return RenderedDrives(seeds, cache, load_config(model), load_table(model, TRAINING, TrainingConfig).rigs)


def render(model: Path, seed: int, cache: Path, until_s: float) -> int | None:
    """The seed, once its drive is there; None when the time is over."""
    if time.time() > until_s:
        return None
    drives_of(model, (seed,), cache).open(0)
    return seed


def rendered(model: Path, seeds: tuple[int, ...], cache: Path, seconds: float) -> tuple[int, ...]:
    """The seeds whose drives all cores have rendered in this time, and before."""
    begun, found = time.time(), []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        for task in as_completed([pool.submit(render, model, seed, cache, begun + seconds) for seed in seeds]):
            found += [seed for seed in [task.result()] if seed is not None]
    say(f"{len(found)} drives after {time.time() - begun:.0f} s")
    return tuple(sorted(found))


def train(model: Path, seeds: tuple[int, ...], asked: argparse.Namespace) -> None:
    """Train for the seconds asked for, start included, and write the weights."""
    changes = {"evaluate_every": "1000000", "checkpoint_every": "1000000"}
    changes |= dict(change.split("=", 1) for change in asked.set)
    options = TrainOptions(
        out=asked.out, steps=10**6, held_out=1, weights=asked.weights, changes=changes,
    )  # fmt: skip
    device = choose_device(asked.device)
    job = prepare_training(str(model), device, DriveOptions(rendered=seeds), options)
    end_s = time.perf_counter() + asked.train_s
    optimizer = TimedOptimizer(**vars(job.config.optimizer), end_s=end_s)
    job = replace(job, config=replace(job.config, optimizer=optimizer))
    with job.lock:
        trainer = Trainer(job)
        updates, saves = 0, save_times(end_s - asked.train_s)
        due = next(saves)
        for progress in trainer.run():
            if progress.loss is not None:
                updates += 1
                if updates in (1, 2, 3) or updates % 100 == 0:
                    waited = f"waited {trainer.waited_s:.1f} s, {left(end_s):.0f} s left"
                    say(f"update {updates}, loss {progress.loss:.4g}, {waited}")
                continue
            if time.perf_counter() > due[1]:
                save(asked.out / f"weights_{due[0]:.0f}.safetensors", trainer)
                due = next(saves)
            if left(end_s) < 0:
                trainer.save_checkpoint()
                break
        save(asked.out / "weights.safetensors", trainer)
    frames = updates * job.config.clips.batch
    say(f"{updates} updates, {frames} frames, {frames / (time.perf_counter() - optimizer.begun_s[0]):.0f} a second")


def save(path: Path, trainer: Trainer) -> None:
    """Write the averaged weights."""
    save_weights(path, trainer.averaged_model(), torch.float16)


def left(end_s: float) -> float:
    """Seconds left."""
    return end_s - time.perf_counter()


def save_times(begun_s: float) -> Iterator[tuple[float, float]]:
    """Seconds after the start of each save, and the time of it."""
    after_s = SAVE_S
    while True:
        yield after_s, begun_s + after_s
        after_s += SAVE_S


if __name__ == "__main__":
    sys.exit(main())
