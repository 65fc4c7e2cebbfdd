"""The exported form of a VAD: ONNX Runtime computes what the model computes, over frames with history."""

from pathlib import Path

import numpy as np
import pytest
from memory_drive import MemoryDrive

from bevcli.inference import run
from bevcli.inference.load import Model
from bevcli.workshop.engines.export_onnx import export_onnx
from bevcli.workshop.engines.exported import FrameDifference, check_exported, difference_lines, load_exported
from bevcli.workshop.vad.vad import VAD

pytest.importorskip("onnxruntime")


@pytest.mark.slow
def test_an_exported_vad_equals_the_model(mini_vad: VAD, tmp_path: Path) -> None:
    file = tmp_path / "vad.onnx"
    export_onnx(mini_vad, file)
    exported = load_exported(file, "onnxruntime")
    drive = MemoryDrive(3)
    *_, last = check_exported(file, Model(mini_vad), drive)
    assert last.further.keys() == {
        "line_class_logits", "line_points", "future_offsets", "mode_logits", "plan_offsets"
    }  # fmt: skip
    assert max(last.further.values()) < 1e-3
    for (_, ours), (_, theirs) in zip(
        run(Model(mini_vad), drive), run(Model(exported, engine="onnxruntime", file=exported.file), drive), strict=True
    ):
        np.testing.assert_allclose(theirs.boxes.scores, ours.boxes.scores, atol=1e-4)
        np.testing.assert_allclose(theirs.boxes.futures, ours.boxes.futures, atol=1e-2)
        (lines, plan), (our_lines, our_plan) = theirs.results, ours.results
        np.testing.assert_allclose(np.stack(lines.points), np.stack(our_lines.points), atol=1e-2)
        assert (lines.classes == our_lines.classes).all()
        np.testing.assert_allclose(plan.paths, our_plan.paths, atol=1e-2)


def test_differences_of_further_outputs_have_columns() -> None:
    frames = [
        FrameDifference(frame, 0, 0, 0, 1, 0, 0, {"plan_offsets": value}) for frame, value in ((3, 0.5), (4, 0.1))
    ]
    heads, *rows = (line.split() for line in difference_lines(frames))
    assert heads[-1] == "plan_offsets"
    assert [(row[0], row[-1]) for row in rows] == [("3", "5.0e-01"), ("4", "1.0e-01"), ("largest", "5.0e-01")]
