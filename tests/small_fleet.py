"""A fleet of small drives, and a model whose step takes milliseconds."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from memory_drive import MemorySequence, make_camera
from recorded_drive import with_truth

from bevcli.batch.job import Job
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.pipeline.camera_assignment import NUSCENES_YAWS_DEG
from bevcli.pipeline.run import RunOptions
from bevcli.recording.options import RecordingOptions
from bevcli.sequences.native.writer import NativeWriter

MINI_TOML = """
name = "mini"
classes = ["car", "truck", "construction_vehicle", "bus", "trailer",
  "barrier", "motorcycle", "bicycle", "pedestrian", "traffic_cone"]
cameras = ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"]
channels = 16
[image]
size = [80, 45]
color_order = "rgb"
mean = [123.0, 116.0, 103.0]
std = [58.0, 57.0, 57.0]
[bev_grid]
rows = 8
columns = 8
[backbone]
blocks = [1, 1, 1, 1]
width = 4
[encoder]
layers = 1
attention_heads = 2
[decoder]
layers = 1
attention_heads = 2
queries = 20
max_boxes = 10
[tracking]
birth_score = 0.0
keep_score = 0.0
"""
RIG = CameraRig(
    tuple(make_camera(name, yaw, 80, 45) for name, yaw in NUSCENES_YAWS_DEG.items()), default_ego_from_bev()
)


class SmallDrive(MemorySequence):
    """Noise images of 80 x 45 pixels, which differ from drive to drive."""

    def __init__(self, seed: int, frames: int):
        super().__init__(frames, RIG)
        self.seed = seed

    def load(self, place):
        frame = super().load(place)
        images = {
            name: replace(image, pixels_bgr=np.roll(image.pixels_bgr, self.seed + 1, axis=1))
            for name, image in frame.images.items()
        }
        return replace(frame, images=images)


def write_drive(folder: Path, seed: int, frames: int = 3, *, truth: bool = False) -> Path:
    """A native sequence folder."""
    drive = SmallDrive(seed, frames)
    with NativeWriter(folder, with_ego_motion=True) as writer:
        for place in range(frames):
            frame = drive.load(place)
            writer.write(with_truth(frame) if truth else frame)
    return folder


def write_fleet(folder: Path, count: int, frames: int = 3, *, truth: bool = False) -> list[Path]:
    """Drives d000, d001, …"""
    return [write_drive(folder / f"d{seed:03d}", seed, frames, truth=truth) for seed in range(count)]


def make_job(out: Path | str, toml: Path, **options) -> Job:
    """A job as the command line makes it."""
    run = RunOptions(recording=RecordingOptions(score=0.0))
    reading = {"rate_hz": None, "ego_motion": "required"}
    return Job(str(out), str(toml), untrained=True, device="cpu", reading=reading, run=run, **options)


def results_of(out: Path) -> dict[str, Path]:
    """Name of a drive -> folder of its results."""
    return {path.name.rpartition("-")[0]: path for path in (out / "drives").iterdir()}


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    """`bevcli …` in a folder, with one thread per process."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "bevcli", *arguments]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def command(folder: Path, *arguments: str, timeout: float = 300) -> subprocess.CompletedProcess:
    """The finished `bevcli …`."""
    process = start(folder, *arguments)
    try:
        out, err = process.communicate(timeout=timeout)
    finally:
        process.kill()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)
