"""A new type of results: one class, and the model that has it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from memory_drive import MemoryDrive

from bevcli.frame import FrameResult, Ground, GroundLines
from bevcli.inference.load import Model
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.config import ModelConfig
from bevcli.model.step import ModelOutputs
from bevcli.recording import entities
from bevcli.runs.run_into_folder import run_into_folder
from bevcli.sequences.files.incremental_json import GrowingFile
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop.video import RecordedImages, draw_frame, tiles

RED = (255, 0, 0)


class StopLineFile(GrowingFile):
    """stop_lines.txt: the distance of the stop line, a frame a line."""

    def __init__(self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None) -> None:
        super().__init__(path, resume_at)

    def write(self, ground: Ground, result: StopLine | None) -> None:
        self.append(f"{ground.stamp.index} {None if result is None else result.ahead_m}\n".encode())


@dataclass(frozen=True)
class StopLine(FrameResult):
    """A line across the lane, so many metres ahead."""

    kind = "stop_line"
    file_name = "stop_lines.txt"
    writer = StopLineFile

    ahead_m: float

    @classmethod
    def legend(cls, names):
        return dict.fromkeys(names, RED)

    def drawn(self, ground, names, score):
        return GroundLines([ground.points(np.array([[-2.0, self.ahead_m], [2.0, self.ahead_m]]))], [(*RED, 255)], 2.0)


@dataclass(frozen=True)
class StoppingConfig(ModelConfig):
    @property
    def results(self):
        return {StopLine: ("stop line",)}


class Stopping(BEVFormer):
    def decode(self, outputs: ModelOutputs) -> Iterator[Any]:
        yield from super().decode(outputs)
        yield StopLine(10.0)


def test_a_new_result_has_a_file_a_drawing_and_a_legend(mini_config, tmp_path):
    settings = {field.name: getattr(mini_config, field.name) for field in fields(ModelConfig)}
    model = Model(Stopping(StoppingConfig(**settings)).eval())
    run_into_folder(model, MemoryDrive(2), tmp_path / "out")
    assert (tmp_path / "out/stop_lines.txt").read_text() == "0 10.0\n1 10.0\n"
    for frame in RecordingReader(tmp_path / "out/recording.rrd").frames():
        (line,) = frame.strips(f"{entities.BEV}/stop_line", "LineStrips2D:strips")
        np.testing.assert_allclose(line, [[-2, -10], [2, -10]], atol=1e-3)
        assert frame.texts(entities.RUN, "line_names")[0] == "stop line"
        from_above = draw_frame(frame, tiles(frame), RecordedImages())[:, 1280:].astype(int)
        assert (np.abs(from_above - RED[::-1]).max(-1) < 60).sum() > 10
