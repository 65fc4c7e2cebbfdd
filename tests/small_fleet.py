"""A fleet of small drives."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from memory_drive import MemoryDrive, make_camera
from recorded_drive import with_truth

from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, CameraRig, default_ego_from_bev
from bevcli.inference import ModelOptions
from bevcli.recording import RecordingOptions
from bevcli.runs.run_into_folder import RunOptions
from bevcli.workshop.batch.job import Job
from bevcli.workshop.formats.output import NativeWriter

CAMERAS = tuple(make_camera(name, yaw, 80, 45) for name, yaw in NUSCENES_YAWS_DEG.items())
RIG = CameraRig(CAMERAS, default_ego_from_bev())


class SmallDrive(MemoryDrive):
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
    return Job(str(out), ModelOptions(str(toml), untrained=True, device="cpu"), run=run, **options)


def results_of(out: Path) -> dict[str, Path]:
    """Name of a drive -> folder of its results."""
    return {path.name.rpartition("-")[0]: path for path in (out / "drives").iterdir()}
