"""Trains the horizon of the model demo (`bevcli.model.horizon`) on rendered drives.

    python tests/tools/horizon.py OUT [--drives 30000:30160] [--seconds 1200] [--weights FILE] [--seed 0]

1. Drives with random rigs, varied looks and bodies that move are rendered into OUT/drives, and the rings of their
   frames kept in OUT/rings/SEED.pt, with the slopes that their poses tell, unless these do not. What is there is used.
2. The network learns from these rings, turned as if the vehicle had pitched and rolled further; from random weights,
   or on from those that it wrote before, at a quarter of the rate.

Weights: OUT/horizon.safetensors, with the keys that they have in the model's file. The last drives are held out; how
far off it is on them is printed. One thread takes 6 s for a drive, and 0.3 s for an update.
"""

import argparse
import math
import os
import sys
import time
from pathlib import Path

import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.config import load_config
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.horizon import COLUMNS, ROWS, STEP_DEG, UNIT, Horizon, Ring
from bevcli.model.kernels.choose import fold_batch_norms
from bevcli.model.road_slopes import RoadSlopes, level_from_bev
from bevcli.printing import say
from bevcli.workshop.synth import parse_seeds
from bevcli.workshop.synth.drives import RenderedDrives
from bevcli.workshop.synth.rig import RigDistribution, draw_rig

KEPT_ROWS = 144  # of the rings, more than the network sees, as they are turned
GREY, CONTRAST = 110.0, 45.0  # of the kept rings
DOUBT = 2.0  # times the variance that fits drives of a training, on others: chosen on four of these
HELD_OUT = 12  # drives
BATCH, RATE = 12, 2e-3
PITCH_DEG, ROLL_DEG = 1.6, 1.3  # largest standard deviation of what is added
LOST, WORSE = 0.25, 0.2  # share of rings that lose a camera, that are blurred, foggy, or very noisy
NOISE, GAMMA = 0.15, 0.35  # of the grey levels
RIGS = RigDistribution(
    random_share=0.65, moving_share=0.4, unstated_share=0.35, varied_share=0.6, supersampled_share=0.3
)  # fmt: skip


def main() -> int:
    """Render, look, train."""
    parser = argparse.ArgumentParser(description="Train the horizon of the model demo on rendered drives.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--drives", type=parse_seeds, default=parse_seeds("30000:30160"))
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--weights", type=Path, help="to go on from, such as OUT/horizon.safetensors")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    (asked.out / "rings").mkdir(parents=True, exist_ok=True)
    size = load_config("demo").image.size
    stated = [seed for seed in asked.drives if draw_rig(RIGS, seed, size).body != "unstated"]
    rings = [kept_rings(seed, asked.out) for seed in stated]
    held = joined(rings[-HELD_OUT:])
    begun = {} if asked.weights is None else safetensors.torch.load_file(asked.weights)
    horizon = train(joined(rings[:-HELD_OUT]), held, asked.seconds, asked.seed, begun)
    state = {f"horizon.{key}": value.half() for key, value in horizon.state_dict().items()}
    safetensors.torch.save_file(state, asked.out / "horizon.safetensors")
    return 0


def kept_rings(seed: int, out: Path) -> dict[str, Tensor]:
    """The rings of a drive, in grey levels of 0 to 255, 0 where no camera looks; its cameras; the true slopes."""
    path = out / "rings" / f"{seed}.pt"
    if not path.exists():
        torch.save(rings_of(seed, out), path.with_suffix(".part"))
        os.replace(path.with_suffix(".part"), path)
        say(f"drive {seed}")
    kept: dict[str, Tensor] = torch.load(path)
    return kept


@torch.no_grad()
def rings_of(seed: int, out: Path) -> dict[str, Tensor]:
    """See `kept_rings`: ring (frames, KEPT_ROWS, COLUMNS) uint8, camera as ring, slopes (frames, 2)."""
    config = load_config("demo")
    drive, prepare = RenderedDrives((seed,), out / "drives", config, RIGS).open(0), Preprocessor(config, threads=1)
    horizon = Horizon()
    horizon.ring = Ring(KEPT_ROWS)
    rings, cameras, slopes = [], [], []
    for index in range(len(drive.stamps)):
        prepared = prepare(drive.load(index))
        places = prepared.images, prepared.image_from_bev.float()
        ring, seen = horizon.view(*places)
        rings.append((ring * CONTRAST + GREY).clamp(1, 255).mul(seen)[0].byte())
        row = (horizon.ring(places[1], tuple(prepared.images.shape[-2:]))[0, ..., 1] + 1) / 2
        cameras.append((row * prepared.images.shape[1]).floor().byte().where(seen[0] > 0, 255))
        frame = prepared.frame
        normal = (frame.world_from_ego.matrix @ frame.rig.ego_from_bev)[2, :3]  # of the road, in the bev frame
        slopes.append([-normal[0] / normal[2], -normal[1] / normal[2]])
    return {"ring": torch.stack(rings), "camera": torch.stack(cameras), "slopes": torch.tensor(slopes).float()}


def joined(rings: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """The rings of several drives."""
    return {key: torch.cat([ring[key] for ring in rings]) for key in rings[0]}


def turned(data: dict[str, Tensor], index: Tensor, added: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rings of `ROWS` as vehicles see them that are turned by slopes (B, 2); their cameras; the slopes then."""
    turn = torch.stack([torch.stack(row, -1) for row in level_from_bev(*added.unbind(-1))], -2)  # (B, 3, 3)
    ray = torch.einsum("bij,jp->bip", turn, Ring().rays)
    step = math.radians(STEP_DEG)
    row = (KEPT_ROWS - 1) / 2 - torch.asin(ray[:, 2].clamp(-1, 1)) / step
    column = torch.atan2(ray[:, 1], ray[:, 0]) / step + (COLUMNS - 1) / 2
    places = torch.stack([(2 * column + 1) / COLUMNS - 1, (2 * row + 1) / KEPT_ROWS - 1], -1)
    places = places.unflatten(1, (ROWS, COLUMNS))
    rings, cameras = (
        F.grid_sample(data[key][index][:, None].float(), places, mode, "border", align_corners=False)[:, 0]
        for key, mode in (("ring", "bilinear"), ("camera", "nearest"))
    )
    normal = F.pad(-data["slopes"][index], (0, 1), value=1.0)
    normal = (turn.transpose(1, 2) @ normal[..., None])[..., 0]
    return rings, cameras, -normal[:, :2] / normal[:, 2:]


def changed(rings: Tensor, cameras: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rings in bad light, fog or motion, and what is seen of them: a camera may be lost, and its images be black."""
    count = len(rings)

    def draw(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=random)

    light = torch.exp(GAMMA * torch.randn(count, 1, 1, generator=random))
    changed = ((rings.clamp(1, 255) / 255) ** light * 255 - GREY) / CONTRAST
    fog = F.interpolate(draw(1, 4, 24), (ROWS, COLUMNS), mode="bilinear", align_corners=False)[:, 0]
    changed = torch.lerp(changed, torch.tensor(3.0), fog * draw(1, 1) * (draw(1, 1) < WORSE))
    size = 2 * int(torch.randint(2, 9, (), generator=random)) + 1
    blurred = F.avg_pool2d(F.pad(changed[:, None], (size // 2, size // 2, 0, 0), mode="circular"), (1, size), 1)[:, 0]
    changed = blurred.where(draw(1, 1) < WORSE, changed)
    noise = NOISE * torch.where(draw(1, 1) < WORSE, 5.0, 1.0) * draw(1, 1)
    changed = changed + noise * torch.randn(rings.shape, generator=random)
    lost = (cameras == torch.randint(0, 8, (count, 1, 1), generator=random)) & (draw(1, 1) < LOST)
    black = draw(1, 1) < 0.5
    changed = changed.where(~lost, -GREY / CONTRAST)
    return changed, ((cameras != 255) & (black | ~lost)).float()


def train(
    data: dict[str, Tensor], held: dict[str, Tensor], seconds: float, seed: int, begun: dict[str, Tensor]
) -> Horizon:
    """The horizon after so many seconds. begun: weights to go on from, empty for random ones."""
    torch.manual_seed(seed)
    random, horizon, rate = torch.Generator().manual_seed(seed), Horizon(), RATE / 4 if begun else RATE
    if begun:
        horizon.load_state_dict({key.removeprefix("horizon."): value.float() for key, value in begun.items()})
        horizon.log_shares.data += math.log(DOUBT)
    else:
        plain = list(horizon.network)
        norms = [[x, nn.BatchNorm2d(x.out_channels)] if isinstance(x, nn.Conv2d) else [x] for x in plain[:-1]]
        horizon.network = nn.Sequential(*(module for pair in norms for module in pair), plain[-1])
    horizon.requires_grad_(True)
    optimizer = torch.optim.AdamW(horizon.parameters(), weight_decay=0.02)
    start, updates, said = time.perf_counter(), 0, 0.0
    largest = torch.deg2rad(torch.tensor([PITCH_DEG, ROLL_DEG]))
    while (done := (time.perf_counter() - start) / seconds) < 1:
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, 0.05 + updates / 50) * (0.01 + 0.99 * (1 + math.cos(math.pi * done)) / 2)
        index = torch.randint(len(data["slopes"]), (BATCH,), generator=random)
        spread = torch.rand(BATCH, 1, generator=random) * largest
        rings, cameras, slopes = turned(data, index, torch.randn(BATCH, 2, generator=random) * spread)
        rings, seen = changed(rings, cameras, random)
        if updates % 2:  # the mirror image
            rings, seen, slopes = rings.flip(-1), seen.flip(-1), slopes * torch.tensor([1.0, -1.0])
        rises, errors = horizon.rises(rings, seen)
        truth = (slopes[:, None, None] * horizon.told).sum(-1)  # (B, 2, COLUMNS / FOLD)
        looks = errors < math.inf
        known = errors.where(looks, 0.0)
        each = (((rises - truth).abs() / UNIT * (-known).exp() + known) * looks).mean() * 2
        whole = unlikeliness(horizon.slopes(rises, errors), slopes).mean()
        loss = each + min(1.0, max(0.0, (updates - 150) / 300)) * whole
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(horizon.parameters(), 5.0)
        optimizer.step()
        updates += 1
        if time.perf_counter() - start > said:
            say(f"{updates} updates, {done:.0%}, loss {loss.item():.3f}: {errors_on(held, horizon)}")
            said += max(120.0, seconds / 20)
    horizon.eval().requires_grad_(False)
    fold_batch_norms(horizon.network, torch.device("meta"))
    horizon.network = nn.Sequential(*(x for x in horizon.network if not isinstance(x, nn.Identity)))
    horizon.log_shares -= math.log(DOUBT)
    say(f"{updates} updates: {errors_on(held, horizon)}")
    return horizon


def unlikeliness(told: RoadSlopes, truth: Tensor) -> Tensor:
    """(B,) minus the logarithm of the likelihood of true slopes (B, 2), but for a constant."""
    off = (truth - told.mean)[..., None]
    return (off.transpose(1, 2) @ torch.linalg.solve(told.covariance, off))[:, 0, 0] / 2 + told.covariance.logdet() / 2


@torch.no_grad()
def errors_on(data: dict[str, Tensor], horizon: Horizon) -> str:
    """The errors on every third ring, each turned by a draw of its own."""
    horizon.eval()
    random, errors = torch.Generator().manual_seed(1), []
    for index in torch.arange(0, len(data["slopes"]), 3).split(BATCH):
        added = torch.deg2rad(torch.tensor([1.0, 0.5])) * torch.randn(len(index), 2, generator=random)
        rings, cameras, slopes = turned(data, index, added)
        seen = (cameras != 255).float()
        errors.append(horizon.slopes(*horizon.rises((rings - GREY) / CONTRAST, seen)).mean - slopes)
    horizon.train()
    off = torch.rad2deg(torch.cat(errors))
    (pitch, roll), (mid_pitch, mid_roll) = off.square().mean(0).sqrt().tolist(), off.abs().median(0).values.tolist()
    medians = f"medians {mid_pitch:.3f} and {mid_roll:.3f}"
    return f"off by {pitch:.3f} and {roll:.3f} degrees along x and y in the mean square, {medians}"


if __name__ == "__main__":
    sys.exit(main())
