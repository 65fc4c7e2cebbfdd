"""A new model file for a data set: from a preset and the facts about the data, with what its training costs here."""

import copy
import math
import re
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bevcli.config import TRAINING, as_toml, load_config, read_model_file
from bevcli.errors import InputError, OutputError
from bevcli.frame import Drive
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig, level_rig
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Array
from bevcli.model.config import BevFrameConfig, fov_deg, tilt_deg
from bevcli.printing import counted, duration
from bevcli.sequences.open import open_sequence, scenes_of, select_rate
from bevcli.sequences.options import InputOptions
from bevcli.workshop.benchmark.measure import peak_memory
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.synth.drives import read_split
from bevcli.workshop.training import Preset, TrainOptions
from bevcli.workshop.training.job import TrainingConfig, TrainingJob, prepare_training
from bevcli.workshop.training.targets import ground_truth_boxes
from bevcli.workshop.training.trainer import Trainer
from bevcli.workshop.training.validation import longest_scene
from bevcli.writing import write_whole

INSIDE_PERCENT = 95.0  # of the boxes that the BEV range takes in
LARGEST_HELD_OUT = 10  # drives
NEAREST_RATE = 0.75  # data with at least this share of the preset's frame rate is trained at the preset's
# Mean length, width and height of their boxes in nuScenes, metres.
NUSCENES_SIZES: Mapping[str, tuple[float, float, float]] = {
    "car": (4.6, 1.95, 1.72),
    "truck": (6.93, 2.51, 2.84),
    "construction_vehicle": (6.37, 2.73, 3.19),
    "bus": (10.5, 2.94, 3.47),
    "trailer": (12.29, 2.9, 3.87),
    "barrier": (0.5, 2.53, 0.98),
    "motorcycle": (2.11, 0.77, 1.47),
    "bicycle": (1.7, 0.6, 1.28),
    "pedestrian": (0.73, 0.67, 1.77),
    "traffic_cone": (0.41, 0.41, 1.07),
}


@dataclass(frozen=True)
class DataFacts:
    """What some drives contain."""

    drives: tuple[Drive, ...]  # the drives, with all their frames
    frames: int  # number of frames with ground truth
    class_counts: dict[str, int]  # number of boxes by class, the most frequent first
    class_sizes: dict[str, tuple[float, float, float]]  # median length, width and height of the boxes by class, metres
    rigs: tuple[CameraRig, ...]  # the rig of each drive
    rate_hz: float  # median rate of the frames with ground truth, per second
    centers_bev: Array  # (N, 3) centres of all boxes in the bev frame, metres
    map_reach_m: float  # distance that all ground-truth maps cover to each side, metres; 0 without maps

    @property
    def cameras(self) -> tuple[str, ...]:
        """The names of the cameras of all rigs."""
        return tuple(dict.fromkeys(name for rig in self.rigs for name in rig.names))

    @property
    def image_size(self) -> tuple[int, int]:
        """The most frequent width and height of the images, pixels."""
        sizes = Counter((camera.width, camera.height) for rig in self.rigs for camera in rig.cameras)
        return sizes.most_common(1)[0][0]

    @property
    def reach_m(self) -> float:
        """Half the side of a square around the vehicle that holds 95 % of the boxes, metres."""
        return float(np.percentile(np.abs(self.centers_bev[:, :2]).max(axis=1), INSIDE_PERCENT))

    def shortest(self, rate_hz: float) -> int:
        """Frames of the longest scene of the shortest drive, at a frame rate."""
        return min(longest_scene(select_rate(drive, rate_hz)) for drive in self.drives)


def look_at(drives: Sequence[Drive], bev_frame: BevFrameConfig) -> DataFacts:
    """Read the ground truth of all frames of some drives. Raises InputError where there is none, or no box.

    bev_frame: of the model, for the centres of the boxes.
    """
    labelled: list[Boxes3D] = []
    gaps_s: list[Array] = []
    map_reaches: list[float] = []
    for drive in drives:
        frames = [drive.ground_truth_frame(index) for index in range(len(drive.stamps))]
        frames = [frame for frame in frames if frame.ground_truth is not None]
        if not frames:
            raise InputError(f"{drive.name}: has no ground truth boxes (expected for training): leave it out")
        for frame in frames:
            rig = level_rig(frame.rig, bev_frame.height_m) if bev_frame.level else frame.rig
            labelled.append(ground_truth_boxes(replace(frame, rig=rig)))
        stamps = [frame.stamp for frame in frames]
        gaps_s += [np.diff([stamps[i].timestamp_ns for i in scene]) / 1e9 for scene in scenes_of(stamps)]
        maps = [frame.ground_truth_map for frame in frames if frame.ground_truth_map is not None]
        map_reaches += [min(abs(end) for end in (*bev_map.x_range_m, *bev_map.y_range_m)) for bev_map in maps]
    names = np.concatenate([boxes.classes for boxes in labelled])
    if not len(names):
        raise InputError(f"the {len(drives)} drives have no boxes (expected some to train on)")
    counts = dict(Counter(names.tolist()).most_common())
    sizes = np.concatenate([boxes.sizes_lwh for boxes in labelled])
    medians = {name: tuple(np.median(sizes[names == name], axis=0).tolist()) for name in counts}
    gaps = np.concatenate(gaps_s)
    rate_hz = 1 / float(np.median(gaps)) if len(gaps) else 2.0
    rigs = tuple(drive.rig for drive in drives)
    reach_m = min(map_reaches, default=0.0)
    centers = np.concatenate([boxes.centers for boxes in labelled])
    return DataFacts(tuple(drives), len(labelled), counts, medians, rigs, rate_hz, centers, reach_m)


Changes = Mapping[str, Mapping[str, Any]]  # of a model's file: keys of its tables with new values; None removes a key
# The demo model on smaller images and shorter clips, for a training that starts from its weights. The rate and the
# average are those with which docs/fine-tune.md was measured.
_QUICK: Changes = {
    "image": {"size": [384, 216], "focal_px": None, "max_pixels": None},
    "training": {"steps": 75, "evaluate_every": 15, "checkpoint_every": 5},
    "training.clips": {"frames": 8, "batch": 2, "in_turn": 2},
    "training.optimizer": {"learning_rate": 2e-4, "warm_up_steps": 10, "average": 0.99},
    "training.perspective_loss": {"weight": 0.0},
}
_ONE_CLIP: Changes = {"training.clips": {"batch": 1}}  # as published, on each of eight GPUs
# The known model whose file a preset starts from, and the changes.
PRESETS: Mapping[Preset, tuple[str, Changes]] = {
    "quick": ("demo", _QUICK),
    "photographs": ("photographs", {table: changes for table, changes in _QUICK.items() if table != "image"}),
    "demo": ("demo", {}),
    "tiny": ("tiny", _ONE_CLIP),
    "base": ("base", _ONE_CLIP),
}


def rigs_of(rigs: Iterable[CameraRig]) -> dict[str, Any]:
    """The table [training_rigs] of a model that is trained on some rigs."""
    rigs = [rig for rig in rigs if rig.cameras]
    cameras = [camera for rig in rigs for camera in rig.cameras]
    counts = [len(rig.cameras) for rig in rigs]
    fovs = [fov_deg(camera) for camera in cameras]
    heights = [float(camera.ego_from_camera[2, 3]) for camera in cameras]
    return {
        "cameras": [min(counts), max(counts)],
        "fov_deg": [float(math.floor(min(fovs))), float(math.ceil(max(fovs)))],
        "height_m": [round(min(heights), 2), round(max(heights), 2)],
        "tilt_deg": round(max(map(tilt_deg, cameras)), 1),
    }


def model_table(name: str, preset: Preset, data: DataFacts) -> dict[str, Any]:
    """The contents of a model's file for a data set.

    The number of BEV cells and all layers are those of the preset's model, so that its weights fit, except those of
    its classes and cameras. The BEV range is a square of whole metres that holds most boxes. The settings are for a
    training that starts from these weights. name: of the new model.
    """
    model, changes_by_table = PRESETS[preset]
    table = copy.deepcopy(read_model_file(model)[0])
    for path, changes in changes_by_table.items():
        _change(table, path, changes)
    official = [label for label in NUSCENES_CLASSES if label in data.class_counts]
    further = [label for label in data.class_counts if label not in NUSCENES_CLASSES]  # the most frequent first
    table |= {"name": name, "classes": official + further, "cameras": list(data.cameras)}
    if further:
        table["class_settings"] = {name: {"like": class_of_size(*data.class_sizes[name])} for name in further}
    table.setdefault("rate_hz", 2.0)
    if data.rate_hz < NEAREST_RATE * table["rate_hz"]:
        table["rate_hz"] = float(f"{data.rate_hz:.2g}")
    table["max_gap_s"] = max(table.get("max_gap_s", 2.0), round(2 / table["rate_hz"], 2))
    (width, height), grid = data.image_size, table["bev_grid"]
    size = min(table["image"]["size"][0], width)
    table["image"]["size"] = [size, max(1, round(size * height / width))]
    half = float(max(4, math.ceil(round(data.reach_m, 3))))
    grid["x_range_m"] = grid["y_range_m"] = [-half, half]
    (low, high), (z0, z1) = np.percentile(data.centers_bev[:, 2], (1, 99)), grid["z_range_m"]
    grid["z_range_m"] = [float(min(z0, math.floor(low))), float(max(z1, math.ceil(high)))]
    table["training_rigs"] = rigs_of(data.rigs)
    if data.map_reach_m < half:
        table["heads"] = ["detection"]
        table.pop("segmentation", None)
    table.pop("horizon", None)  # it knows renderings only, and is not trained
    training = table.setdefault(TRAINING, {})
    training.pop("rigs", None)  # of rendered drives
    training["freeze_batch_norm"] = True  # a few small batches of other images would spoil the statistics
    training["held_out"] = 0 if len(data.drives) == 1 else min(LARGEST_HELD_OUT, max(1, len(data.drives) // 5))
    clips = training.setdefault("clips", {})
    clips["frames"] = min(clips.get("frames", TrainingConfig().clips.frames), data.shortest(table["rate_hz"]))
    return table


def _change(table: dict[str, Any], path: str, changes: Mapping[str, Any]) -> None:
    for name in path.split("."):
        table = table.setdefault(name, {})
    for key, value in changes.items():
        if value is None:
            table.pop(key, None)
        else:
            table[key] = value


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
    text = "\n".join([*(f"# {line}" for line in lines), as_toml(table)])
    write_whole(path, text.encode(), parents=True)
    return lines


def _cost_of(table: Mapping[str, Any], device: torch.device, data: DriveOptions, longest_s: float) -> "Cost":
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / "model.toml"
        write_whole(trial, as_toml(table).encode())
        job = prepare_training(str(trial), device, data, TrainOptions(out=Path(folder) / "out"))
        return measure_cost(job, longest_s)


def fitting_batch(batch: int, used_bytes: int, card_bytes: int, most: int) -> int:
    """The clips of a batch that fill a card, at least `batch`, which used so much memory, and else at most `most`.

    The memory of a clip is overestimated by its share of the memory that does not depend on the batch.
    """
    return max(batch, min(most, int(MEMORY_SHARE * card_bytes * batch / used_bytes)))


def _open_drives(data: DriveOptions) -> list[Drive]:
    """All drives, at their own frame rate. Raises InputError."""
    if data.rendered is not None:
        raise InputError(
            "`init` (`--init`) needs drives in folders (`data` (`--data`) or `split` (`--split`)): rendered drives "
            "are trained with demo"
        )
    split = None if data.split is None else read_split(data.split)
    folders = data.data if split is None else (*split.train, *split.validate)
    if not folders or (split is not None and data.data):
        raise InputError(
            "`init` (`--init`): choose the drives: give either `data` (`--data DIR`) (repeatable) or `split` "
            "(`--split FILE`)"
        )
    classes = tuple(dict.fromkeys([*NUSCENES_CLASSES, *data.class_map.values()]))
    options = InputOptions(data.class_map, rate_hz="all", classes=classes)
    return [open_sequence(folder, options) for folder in folders]


def _facts_lines(data: DataFacts, table: Mapping[str, Any]) -> Iterator[str]:
    """The facts that the settings of the file follow from."""
    named = ", ".join(f"{name} {data.class_counts[name]}" for name in table["classes"])
    yield f"Boxes in {counted(data.frames, 'frames')}: {named}."
    alike = ", ".join(f"{name} like {settings['like']}" for name, settings in table.get("class_settings", {}).items())
    if alike:
        yield f"Own classes, by the sizes of their boxes: {alike}; [class_settings] changes it."
    counts = sorted({len(rig.cameras) for rig in data.rigs})
    number = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    sizes = [" x ".join(map(str, size)) for size in (data.image_size, table["image"]["size"])]
    yield f"Cameras: {number}, images of {sizes[0]}, used at {sizes[1]}."
    yield f"Frames per second: {data.rate_hz:.3g}, used at {table['rate_hz']:g}."
    grid = table["bev_grid"]
    half = grid["x_range_m"][1]
    cells = f"{grid['columns']} x {grid['rows']} BEV cells of {2 * half / grid['columns']:.2f} m"
    yield f"{INSIDE_PERCENT:g} % of the boxes are within {data.reach_m:.1f} m ahead and to the sides: {cells}."
    if 0 < data.map_reach_m < half:
        yield f"Maps reach {data.map_reach_m:g} m only, less than the grid: the model has no segmentation head."


@dataclass(frozen=True)
class Cost:
    """The cost of a training."""

    config: TrainingConfig  # its settings
    machine: str  # the device, in words
    update_s: float  # time of an update of the weights, while another thread reads the next batch
    reading_s: float  # time until the first batch was read, at most; 0 where processes read, for which `update_s` waits
    memory_bytes: int  # the largest memory, of the process or of a GPU

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
    # Images are not kept: they would count as memory of the training, and be read sooner than in a longer one.
    config = replace(job.config, steps=10**6, evaluate_every=10**6, checkpoint_every=10**6, kept_share=0.0)
    config = replace(config, clips=replace(config.clips, in_turn=1, short_share=0.0))
    machine = f"{job.device.type}, {torch.get_num_threads()} threads"
    if job.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(job.device)
        machine = torch.cuda.get_device_name(job.device)
    times = [time.perf_counter()]
    for progress in Trainer(replace(job, config=config)).run():
        if progress.loss is not None:
            times.append(time.perf_counter())
            if times[-1] - times[0] >= longest_s:
                break
    spans = [later - earlier for earlier, later in pairwise(times)]
    update_s = sum(spans[1:]) / len(spans[1:]) if len(spans) > 1 else spans[0]
    reading_s = max(spans[0] - update_s, 0.0) if job.loaders == 1 else 0.0  # processes take seconds to start
    return Cost(job.config, machine, update_s, reading_s, peak_memory(job.device))


def class_of_size(*size: float) -> str:
    """The nuScenes class whose boxes are most alike to one of this length, width and height, by their ratios."""
    return min(NUSCENES_SIZES, key=lambda name: np.abs(np.log(np.divide(NUSCENES_SIZES[name], size))).sum())
