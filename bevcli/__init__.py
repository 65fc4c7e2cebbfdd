"""bevcli: run BEVFormer on camera sequences and look at the results.

    import bevcli

    model = bevcli.load_model("demo")
    drive = bevcli.open_sequence("samples/street")
    with bevcli.Recording("street.rrd", drive, model) as recording:
        for frame, prediction in bevcli.run(model, drive):
            recording.log(frame, prediction)

Every name is imported when it is first used: `import bevcli` itself loads no PyTorch. See docs/python.md.
"""

import ast
import importlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bevcli._version import __version__ as __version__

if TYPE_CHECKING:
    from bevcli.errors import BevcliError as BevcliError
    from bevcli.frame import (
        MAP_CLASSES as MAP_CLASSES,
        BevMap as BevMap,
        CameraImage as CameraImage,
        Drive as Drive,
        Frame as Frame,
        FrameStamp as FrameStamp,
        Prediction as Prediction,
        Sequence as Sequence,
    )
    from bevcli.geometry.boxes import Box2D as Box2D, Box3D as Box3D, Boxes2D as Boxes2D, Boxes3D as Boxes3D
    from bevcli.geometry.cameras import Camera as Camera, CameraRig as CameraRig, Distortion as Distortion
    from bevcli.geometry.ego_motion import Kinematics as Kinematics
    from bevcli.geometry.transforms import Pose as Pose
    from bevcli.inference import run as run
    from bevcli.inference.load import Model as Model, load_model as load_model
    from bevcli.recording import RecordingOptions as RecordingOptions
    from bevcli.recording.writer import Recording as Recording
    from bevcli.rig.check_calibration import check_calibration as check_calibration
    from bevcli.runs.run_into_folder import RunOptions as RunOptions, run_into_folder as run_into_folder
    from bevcli.sequences.files.calibration_file import read_calibration as read_calibration
    from bevcli.sequences.open import open_sequence as open_sequence
    from bevcli.viewer.recording_file import screenshot as screenshot, show as show
    from bevcli.workshop.batch.batch import batch as batch
    from bevcli.workshop.calibration.calibrate import calibrate as calibrate
    from bevcli.workshop.engines.exported import export_onnx as export_onnx, quantize as quantize
    from bevcli.workshop.formats.convert import convert as convert, export as export
    from bevcli.workshop.live import Session as Session
    from bevcli.workshop.odometry.measure import measure_motion as measure_motion
    from bevcli.workshop.scores.compare import compare as compare
    from bevcli.workshop.scores.evaluate import evaluate as evaluate
    from bevcli.workshop.scores.record import record as record
    from bevcli.workshop.synth.drive import render as render
    from bevcli.workshop.training.trainer import train as train, validate as validate
    from bevcli.workshop.trust.estimate import estimate_score as estimate_score
    from bevcli.workshop.video import video as video
    from bevcli.workshop.weights.hub import pack_model as pack_model
    from bevcli.workshop.weights.model_file import model_file_for as model_file_for


@cache
def _modules() -> dict[str, str]:
    """The public names by the modules that define them: the imports above, read from this file."""
    body = ast.parse(Path(__file__).read_text(encoding="utf-8")).body
    (block,) = (node for node in body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return list(_modules())
    if name not in _modules():
        raise AttributeError(f"module 'bevcli' has no attribute {name!r}")
    value = getattr(importlib.import_module(_modules()[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_modules()})
