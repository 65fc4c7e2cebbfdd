"""Known predictions and ground truth for a sequence in memory, and a recording of them."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive

from bevcli.config import load_config
from bevcli.errors import OutputError
from bevcli.frame import AttentionView, CameraSamples, Drive, Frame, NewStart, Prediction, Probe, StartReason
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import inverse
from bevcli.model.config import ModelConfig
from bevcli.recording import RecordingOptions
from bevcli.recording.writer import Recording
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader
from bevcli.viewer.rerun_viewer import NO_DRIVER, take_screenshot

GRID = BevGrid(20, 20)
TINY = load_config("tiny")


@dataclass(frozen=True)
class NamedModel:
    """What a recording takes from a model, without a network."""

    untrained: bool = False
    bundled: bool = False
    config: ModelConfig = TINY


def boxes_ahead() -> Boxes3D:
    """A car 12 m ahead, a pedestrian to the right and a bus with score 0.1, in the bev frame (x right, y forward)."""
    return Boxes3D(
        centers=np.array([[0.0, 12, -1], [6, 9, -1], [-9, 20, -0.5]]),
        sizes_lwh=np.array([[4.5, 1.9, 1.6], [0.7, 0.7, 1.8], [11, 2.9, 3.4]]),
        yaws=np.array([np.pi / 2, 0.3, np.pi / 2]),
        velocities=np.array([[0.0, 5], [1, 0], [0, 0]]),
        classes=np.array(["car", "pedestrian", "bus"]),
        scores=np.array([0.9, 0.6, 0.1]),
    )


def predict(frame: Frame) -> Prediction:
    """The boxes above in every frame's bev frame, random BEV features, and one probe."""
    random = np.random.default_rng(frame.stamp.index)
    return Prediction(
        stamp=frame.stamp,
        boxes=boxes_ahead(),
        ego_from_bev=frame.rig.ego_from_bev,
        world_from_ego=frame.world_from_ego,
        grid=GRID,
        bev=torch.tensor(random.normal(size=(GRID.rows * GRID.columns, 16)), dtype=torch.float32),
        started_anew=None if frame.stamp.index else NewStart(StartReason.FIRST_FRAME),
        stage_seconds={"backbone": 0.2, "encoder": 0.1},
        attention=AttentionView(
            np.full((GRID.rows, GRID.columns), 0.5),
            (Probe(np.array([0.0, 10.0]), {"CAM_FRONT": CameraSamples(np.array([[100.0, 90]]), np.array([1.0]))}),),
        ),
    )


def with_truth(frame: Frame) -> Frame:
    """The frame with ground truth: the car, and a bicycle that is not predicted."""
    world_from_bev = frame.world_from_ego.matrix @ frame.rig.ego_from_bev
    truth = boxes_ahead()[[0, 0]]
    truth = replace(
        truth, scores=None, classes=np.array(["car", "bicycle"]), centers=truth.centers + [[0, 0, 0], [5, 9, 0]]
    )
    return replace(frame, ground_truth=truth.transformed(world_from_bev))


def record(
    path: Path,
    sequence: MemoryDrive,
    options: RecordingOptions | None = None,
    *,
    untrained: bool = False,
    truth: bool = True,
) -> list[Frame]:
    """Writes a recording of the whole sequence, by default with ground truth; returns its frames."""
    frames = [sequence.load(place) for place in range(len(sequence.stamps))]
    frames = [with_truth(frame) for frame in frames] if truth else frames
    recorded(path, sequence, ((frame, predict(frame)) for frame in frames), NamedModel(untrained), options)
    return frames


def recorded(
    path: Path,
    drive: Drive,
    steps: Iterable[tuple[Frame, Prediction]],
    model: NamedModel | None = None,
    options: RecordingOptions | None = None,
) -> list[RecordedFrame]:
    """Writes a recording of these frames; returns them as they are read back."""
    with Recording(path, drive, model or NamedModel(), options) as recording:
        for frame, prediction in steps:
            recording.log(frame, prediction)
    return list(RecordingReader(path).frames())


def bev_from_world(frame: Frame) -> np.ndarray:
    """(4, 4) at the frame's time."""
    return inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev)


def screenshot_or_skip(recording: Path, image: Path, frame: int | None = None) -> tuple[str, ...]:
    """As `take_screenshot`; skips the test if the viewer cannot draw here."""
    try:
        return take_screenshot(recording, image, frame)
    except OutputError as error:
        if str(error) != NO_DRIVER:
            raise
        pytest.skip(str(error))
