"""bevcli: run BEVFormer on camera sequences and look at the results.

    import bevcli

    model = bevcli.load_model("demo")
    drive = bevcli.open_sequence("samples/street")
    with bevcli.Recording("street.rrd", drive, model) as recording:
        for frame, prediction in bevcli.run(model, drive):
            recording.log(frame, prediction)

Every name is imported when it is first used: `import bevcli` itself loads no PyTorch. See docs/python.md.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from bevcli.errors import BevcliError
    from bevcli.evaluation.evaluate import evaluate
    from bevcli.frame import MAP_CLASSES, BevMap, CameraImage, Frame, FrameStamp, Prediction, Sequence
    from bevcli.geometry.boxes import Boxes3D
    from bevcli.geometry.cameras import Camera, CameraRig
    from bevcli.geometry.transforms import Pose
    from bevcli.pipeline.model_loading import Model, load_model
    from bevcli.pipeline.run import RunOptions, run, run_into_folder
    from bevcli.recording.options import RecordingOptions
    from bevcli.recording.writer import Recording
    from bevcli.rig.check_calibration import check_calibration
    from bevcli.sequences.open import open_sequence
    from bevcli.synth.export import render
    from bevcli.viewer.notebook import show

# The public names, and the modules that define them.
_MODULES = {
    "MAP_CLASSES": "bevcli.frame",
    "BevMap": "bevcli.frame",
    "BevcliError": "bevcli.errors",
    "Boxes3D": "bevcli.geometry.boxes",
    "Camera": "bevcli.geometry.cameras",
    "CameraImage": "bevcli.frame",
    "CameraRig": "bevcli.geometry.cameras",
    "Frame": "bevcli.frame",
    "FrameStamp": "bevcli.frame",
    "Model": "bevcli.pipeline.model_loading",
    "Pose": "bevcli.geometry.transforms",
    "Prediction": "bevcli.frame",
    "Recording": "bevcli.recording.writer",
    "RecordingOptions": "bevcli.recording.options",
    "RunOptions": "bevcli.pipeline.run",
    "Sequence": "bevcli.frame",
    "check_calibration": "bevcli.rig.check_calibration",
    "evaluate": "bevcli.evaluation.evaluate",
    "load_model": "bevcli.pipeline.model_loading",
    "open_sequence": "bevcli.sequences.open",
    "render": "bevcli.synth.export",
    "run": "bevcli.pipeline.run",
    "run_into_folder": "bevcli.pipeline.run",
    "show": "bevcli.viewer.notebook",
}

__all__ = [
    "MAP_CLASSES",
    "BevMap",
    "BevcliError",
    "Boxes3D",
    "Camera",
    "CameraImage",
    "CameraRig",
    "Frame",
    "FrameStamp",
    "Model",
    "Pose",
    "Prediction",
    "Recording",
    "RecordingOptions",
    "RunOptions",
    "Sequence",
    "check_calibration",
    "evaluate",
    "load_model",
    "open_sequence",
    "render",
    "run",
    "run_into_folder",
    "show",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'bevcli' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
