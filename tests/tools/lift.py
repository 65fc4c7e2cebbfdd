"""Trains the lift of a detector's boxes into the bev frame (`bevcli.model.lift`) on rendered drives.

    python tests/tools/nanodet.py OUT/nanodet.safetensors
    python tests/tools/material.py OUT/material
    python tests/tools/lift.py OUT --detector OUT/nanodet.safetensors --material OUT/material \
        [--drives 700000:700060] [--steps 1500] [--seed 0]

1. Six frames of each drive, with random rigs and varied looks, are rendered and passed to the detector. Its boxes and
   the objects that they show go to OUT/boxes/SEED.pt; drives that are there are used, so that it may be stopped.
2. The lift learns from them as if each vehicle had pitched and rolled, grounds were rough, and sizes differed.

Weights: OUT/lift.safetensors. One thread takes 15 s for a drive, and 50 ms for a step.
"""

import argparse
import math
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from bevcli.config import load_config
from bevcli.frame import CameraImage, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import inverse
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import encode
from bevcli.model.image_boxes import ImageBoxes
from bevcli.model.lift import Lift, LiftConfig
from bevcli.model.nanodet import PIXEL_MEAN, PIXEL_STD, NanoDet, NanoDetConfig
from bevcli.printing import say
from bevcli.workshop.synth import parse_seeds
from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.drive import RenderedDrive, RenderedFrame
from bevcli.workshop.synth.rig import RigDistribution, draw_rig

FRAMES, RATE_HZ = 6, 0.4  # of a drive
CAMERAS = 8  # most of a rig
OVERLAP = 0.4  # of a box and what is seen of an object, from which on the box shows it
DISTANCES_M = torch.tensor([0.5, 1.0, 2.0, 4.0])  # of the AP


@dataclass(frozen=True)
class Variation:
    """Standard deviations by which each frame is changed in training.

    Attributes:
        pitch_deg, roll_deg: of the vehicle.
        sway_deg: further ones of each camera.
        rough_m: height of the ground below an object, far from the vehicle.
        height, width: of an object, relative.
        taller: mean of the heights relative to those rendered: cars are 1.53 m high and people 1.70 m, in nuScenes, by
            its published means, 1.74 m and 1.77 m, in KITTI cars 1.53 m.
        edge: of the sides of a box, relative to its size.
        score: of logits.
    """

    pitch_deg: float = 0.9
    roll_deg: float = 0.5
    sway_deg: float = 0.3
    rough_m: float = 0.25
    height: float = 0.08
    width: float = 0.06
    taller: float = 1.06
    edge: float = 0.02
    score: float = 0.4


def main() -> int:
    """Render, detect, train."""
    parser = argparse.ArgumentParser(description="Train the lift of a detector's boxes on rendered drives.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--detector", type=Path, required=True, help="weights that nanodet.py wrote")
    parser.add_argument("--material", default="", help="folder that material.py wrote")
    parser.add_argument("--drives", type=parse_seeds, default=parse_seeds("700000:700060"))
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    (asked.out / "boxes").mkdir(parents=True, exist_ok=True)
    collector = Collector(asked.detector, asked.material)
    frames: list[dict[str, Tensor]] = []
    for seed in asked.drives:
        path = asked.out / "boxes" / f"{seed}.pt"
        if not path.exists():
            torch.save(collector.drive(seed), path.with_suffix(".part"))
            os.replace(path.with_suffix(".part"), path)
        frames += torch.load(path)
    data = {key: torch.stack([frame[key] for frame in frames]) for key in frames[0]}
    say(f"{len(frames)} frames, {int((data['label'] >= 0).sum())} boxes of objects")
    lift = train(data, collector.config.classes, asked.steps, asked.seed)
    safetensors.torch.save_file(lift.state_dict(), asked.out / "lift.safetensors")
    return 0


class Collector:
    """Renders drives and finds the boxes that a detector sees, and the objects that they show."""

    def __init__(self, weights: Path, material: str) -> None:
        model = load_config("photographs")
        image = replace(
            model.image, size=(704, 396), color_order="bgr", mean=PIXEL_MEAN, std=PIXEL_STD, focal_px=None,
            max_pixels=None, auto_levels=False, defog=False, denoise=False,
        )  # fmt: skip
        self.config: ModelConfig = replace(model, image=image)
        self.preprocess = Preprocessor(self.config, threads=1)
        self.detector: NanoDet = NanoDetConfig().build()
        state = safetensors.torch.load_file(weights)
        self.detector.load_state_dict({k.removeprefix("backbone."): x.float() for k, x in state.items()})
        self.detector.eval()
        self.rigs = RigDistribution(
            random_share=0.65, varied_share=0.9, supersampled_share=0.3, coarse_share=0.15, material=material
        )
        self.assets = Assets.build()

    def drive(self, seed: int) -> list[dict[str, Tensor]]:
        """The frames of a drive; all arrays have CAMERAS cameras, the last ones of which may have no boxes."""
        random, drawn = np.random.default_rng([seed, 76]), draw_rig(self.rigs, seed, self.config.image.size)
        drive = RenderedDrive(
            seed, FRAMES, RATE_HZ, drawn, assets=self.assets, supersampling=drawn.supersampling, map_half_extent_m=4.0
        )
        motion, frames = drive.ego_motion(5.0), []
        for index in range(FRAMES):
            seen = drive.frame(index)
            images = {
                name: CameraImage(seen.camera_timestamps_ns[name], spoiled(pixels, drawn.jpeg_quality, random))
                for name, pixels in seen.images.items()
            }
            kinematics = motion.kinematics_at(seen.stamp.timestamp_ns)
            pose, poses = seen.world_from_ego, seen.world_from_ego_at
            frames.append(self._frame(drive, seen, Frame(seen.stamp, drive.rig, images, pose, poses, kinematics)))
        return frames

    @torch.inference_mode()
    def _frame(self, drive: RenderedDrive, seen: RenderedFrame, frame: Frame) -> dict[str, Tensor]:
        prepared = self.preprocess(frame)
        rig, names = prepared.frame.rig, prepared.assignment.cameras
        scales = zip(names, prepared.scales, strict=True)
        sizes = torch.tensor([[round(s * rig[n].width), round(s * rig[n].height)] for n, s in scales]).float()
        found = self.detector.image_boxes(self.detector(prepared.images[0]), prepared.has_image, sizes[None])
        truth = boxes_of(drive, frame.stamp.index).transformed(inverse(frame.world_from_ego.matrix @ rig.ego_from_bev))
        codes = torch.from_numpy(encode(truth)).float()
        labels = torch.tensor([self.config.classes.index(name) for name in truth.classes])
        shown = torch.stack([
            objects_of(found.boxes[0, i], visible_parts(seen.views[name].objects, rig[name], scale, len(truth)))
            for i, (name, scale) in enumerate(zip(names, prepared.scales, strict=True))
        ])  # fmt: skip
        rows = {
            "boxes": found.boxes[0], "scores": found.scores[0], "labels": found.labels[0], "logits": found.logits[0],
            "features": found.features[0].half(), "sizes": sizes, "image_from_bev": prepared.image_from_bev[0].float(),
            "label": torch.where(shown >= 0, labels[shown], -1), "truth": codes[shown] * (shown >= 0)[..., None],
        }  # fmt: skip
        more = [min(i, len(names) - 1) for i in range(CAMERAS)]
        rows = {key: x[more].clone() for key, x in rows.items()}
        rows["scores"][len(names) :], rows["label"][len(names) :] = 0, -1
        return rows


def spoiled(pixels: np.ndarray, quality: int, random: np.random.Generator) -> np.ndarray:
    """An image (H, W, 3) with another brightness, blur and noise, now and then, as a JPEG file has it."""
    image = pixels.astype(np.float32)
    if random.random() < 0.5:
        image = 255 * (image / 255) ** np.exp(random.normal(0, 0.3))
    if random.random() < 0.3:
        image = cv2.GaussianBlur(image, (0, 0), random.uniform(0.4, 1.0))
    if random.random() < 0.3:
        image = image + random.normal(0, random.uniform(2, 10), image.shape)
    encoded = cv2.imencode(".jpg", image.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))


def boxes_of(drive: RenderedDrive, index: int) -> Boxes3D:
    """The objects of a frame in the order in which `RenderedView.objects` counts them, world frame."""
    states = [state for _, state in drive._actors(index)]
    sizes = np.stack([state.body.size_lwh for state in states])
    centers = np.stack([state.position for state in states])
    centers = centers + sizes * [0, 0, 0.5]
    names = np.array([state.body.variant.class_name for state in states])
    return Boxes3D(centers, sizes, np.array([s.yaw for s in states]), np.stack([s.velocity for s in states]), names)


def visible_parts(objects: np.ndarray, camera: Any, scale: float, count: int) -> Tensor:
    """(count, 4) rectangle around what is seen of each object, pixels of the network's input; NaN if hidden."""
    if camera.distortion is not None:
        u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
        u, v = np.nan_to_num(np.moveaxis(camera.distorted(np.stack([u, v], -1)), -1, 0), nan=-9.0).astype(np.float32)
        objects = cv2.remap(objects.astype(np.float32), u, v, cv2.INTER_NEAREST, borderValue=-1.0)
    row, column = np.nonzero(objects >= 0)
    index, parts = objects[row, column].astype(int), np.full((count, 4), np.nan)
    for each in np.unique(index):
        x, y = column[index == each], row[index == each]
        parts[each] = np.array([x.min(), y.min(), x.max() + 1, y.max() + 1]) * scale - 0.5
    return torch.from_numpy(parts).float()


def objects_of(boxes: Tensor, parts: Tensor) -> Tensor:
    """(K,) index of the object that each box (K, 4) shows, by what is seen of it (O, 4); -1 for none."""
    a, b = boxes[:, None], parts.nan_to_num(-1e4)[None]
    shared = (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(min=0).prod(-1)
    areas = ((x[..., 2:] - x[..., :2]).prod(-1) for x in (a, b))
    overlap, index = (shared / (sum(areas) - shared).clamp(min=1e-6)).max(-1)
    return torch.where(overlap > OVERLAP, index, -1)


def train(data: dict[str, Tensor], classes: tuple[str, ...], steps: int, seed: int) -> Lift:
    """A lift that has learned from frames."""
    torch.manual_seed(seed)
    lift, rate = Lift(LiftConfig(), classes), 3e-3
    optimizer = torch.optim.AdamW(lift.parameters(), rate, weight_decay=1e-3)
    for step in range(steps):
        share = min(1, step / 50) * (1 + math.cos(math.pi * step / steps)) / 2
        optimizer.param_groups[0]["lr"] = rate * share + 1e-6
        chosen = torch.randint(len(data["boxes"]), (10,))
        frames = varied({key: x[chosen] for key, x in data.items()}, Variation())
        value = loss(lift, frames)
        optimizer.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(lift.parameters(), 1.0)
        optimizer.step()
        if step % 100 == 0:
            say(f"step {step}, loss {value.item():.3f}")
    return lift.eval()


def varied(frames: dict[str, Tensor], by: Variation) -> dict[str, Tensor]:
    """Frames (F, N, K, ...) with changed projections, boxes, logits and objects, and `slopes` (F, 2) of the ground."""
    count, cameras, many = frames["scores"].shape
    rad, boxes, truth = math.pi / 180, frames["boxes"], frames["truth"].clone()
    matrices, sizes = frames["image_from_bev"], frames["sizes"][:, :, None]
    # Half of the frames are mirrored: x becomes -x, and a yaw changes the sign of the sine of its code.
    mirrored = torch.rand(count, 1, 1, 1) < 0.5
    image = torch.eye(4).repeat(count, cameras, 1, 1)
    image[..., 0, 0], image[..., 0, 2] = -1, frames["sizes"][..., 0] - 1
    matrices = torch.where(mirrored, image @ matrices @ torch.diag(torch.tensor([-1.0, 1, 1, 1])), matrices)
    x0, y0, x1, y1 = boxes.unbind(-1)
    last = sizes[..., 0] - 1
    x0, x1 = (torch.where(mirrored[..., 0], last - b, a) for a, b in ((x0, x1), (x1, x0)))
    truth = torch.where(mirrored, truth * torch.tensor([-1.0, 1, 1, 1, 1, 1, -1, 1, -1, 1]), truth)
    # An object is taller or wider; edges that the image cuts stay.
    taller, wider = (1 + s * torch.randn(count, cameras, many).clamp(-3, 3) for s in (by.height, by.width))
    taller = taller * by.taller
    whole = (y1 < sizes[..., 1] - 4) & (y0 > 4)
    taller = torch.where(whole, taller, 1.0)
    y0, middle, half = y1 - (y1 - y0) * taller, (x0 + x1) / 2, (x1 - x0) / 2 * wider
    x0, x1 = torch.where(x0 > 4, middle - half, x0), torch.where(x1 < last - 4, middle + half, x1)
    truth[..., 4] += (taller - 1) * truth[..., 5].exp() / 2
    truth[..., 5] += taller.log()
    truth[..., 2:4] += wider.log()[..., None]
    # It stands higher or lower, less so near the vehicle.
    far = 1 - torch.exp(-truth[..., :2].norm(dim=-1) / 10)
    up = by.rough_m * far * torch.randn(count, cameras, many) * ((frames["label"] >= 0) & (y1 < sizes[..., 1] - 4))
    before, after = (row_of(matrices, truth, z) for z in (truth[..., 4], truth[..., 4] + up))
    y0, y1 = torch.where(y0 > 4, y0 + after - before, y0), y1 + after - before
    truth[..., 4] += up
    # The vehicle pitches and rolls about a point on the ground, and each camera a little more.
    pitch, roll = by.pitch_deg * rad * torch.randn(count), by.roll_deg * rad * torch.randn(count)
    more = by.sway_deg * rad * torch.randn(2, count, cameras)
    matrices = matrices @ bev_from_level(pitch[:, None] + more[0], roll[:, None] + more[1])
    boxes = torch.stack([x0, y0, x1, y1], -1)
    extent = (boxes[..., 2:] - boxes[..., :2]).clamp(min=1).repeat(1, 1, 1, 2)
    boxes = boxes + torch.randn_like(boxes) * (by.edge * extent + 0.3)
    noise = torch.randn(count, 1, 1, 1) + torch.randn_like(frames["logits"]) / 2
    # The class of a box is its best one before and after.
    logits = frames["logits"] + by.score * noise
    labels = torch.where(frames["labels"] == frames["logits"].argmax(-1), logits.argmax(-1), -1)
    changed = {"boxes": boxes, "logits": logits, "labels": labels, "image_from_bev": matrices, "truth": truth}
    return frames | changed | {"slopes": torch.stack([roll, -pitch], -1)}


def row_of(matrices: Tensor, codes: Tensor, z: Tensor) -> Tensor:
    """(F, N, K) rows, pixels, of the centres of boxes at another height."""
    center = torch.stack([codes[..., 0], codes[..., 1], z, torch.ones_like(z)], -1)
    _, v, depth = (matrices[:, :, None, :3] * center[..., None, :]).sum(-1).unbind(-1)
    return v / depth.clamp(min=1.0)


def bev_from_level(pitch: Tensor, roll: Tensor, ground_z: float = -1.84) -> Tensor:
    """(..., 4, 4) of turns about x and y around a point on the ground, radians."""
    turn = torch.zeros(*pitch.shape, 4, 4)
    (cp, sp), (cr, sr), zero = (pitch.cos(), pitch.sin()), (roll.cos(), roll.sin()), torch.zeros_like(pitch)
    rows = ((cr, zero, sr), (sp * sr, cp, -sp * cr), (-cp * sr, sp, cp * cr))
    turn[..., :3, :3] = torch.stack([torch.stack(row, -1) for row in rows], -2)
    turn[..., :3, 3] = -ground_z * turn[..., :3, 2]
    turn[..., 2, 3] += ground_z
    turn[..., 3, 3] = 1
    return turn


def loss(lift: Lift, frames: dict[str, Tensor]) -> Tensor:
    """How far boxes are off, and how wrong their scores are: a box is as right as the AP says at four distances."""
    parts = ("boxes", "scores", "labels", "logits", "features")
    found = ImageBoxes(
        *(frames[key].float() if key == "features" else frames[key] for key in parts), cells=frames["boxes"]
    )
    logits, codes, slopes = lift(found, frames["image_from_bev"], frames["sizes"])
    label, truth, counts = frames["label"].flatten(1), frames["truth"].flatten(1, 2), frames["scores"].flatten(1) > 0
    good = (label >= 0) & counts & (frames["labels"].flatten(1) >= 0)
    target, off = torch.zeros_like(logits), (codes[..., :2] - truth[..., :2]).square().sum(-1).add(1e-4).sqrt()
    target[good, label[good]] = (off.detach()[good][:, None] < DISTANCES_M).float().mean(-1)
    scores = nn.functional.binary_cross_entropy_with_logits(logits, target, reduction="none").sum(-1)
    scores = (scores * (frames["labels"].flatten(1) >= 0) * counts).mean()
    off, away, error = off[good], truth[good][:, :2].norm(dim=-1), (codes - truth)[good].abs()
    weights = (away < 50) / (1 + away / 20) * frames["logits"].flatten(1, 2)[good].amax(-1).sigmoid().sqrt()
    relative = off / (1 + away / 10)
    near = (1 - torch.exp(-off[:, None] / DISTANCES_M)).mean(-1)
    place = (weights * (nn.functional.smooth_l1_loss(relative, 0 * relative, reduction="none", beta=0.3) + near)).sum()
    shape = 0.2 * error[:, [2, 3, 5]].mean() + 0.1 * error[:, 4].mean() + 0.1 * error[:, 6:8].mean()
    tilt = (slopes.mean - frames["slopes"]).abs().mean() * 180 / math.pi
    return scores + place / weights.sum() + shape + 0.3 * tilt


if __name__ == "__main__":
    sys.exit(main())
