"""`in_engine`: a model that is named, as an exported file in another engine, made once and kept."""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TypeVar

import msgspec
import torch

from bevcli._version import __version__
from bevcli.errors import InputError
from bevcli.frame import Frame, FrameStamp, Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose
from bevcli.inference.load import Model
from bevcli.inference.options import TORCH
from bevcli.inference.preprocess import Preprocessor, calibration_images
from bevcli.inference.runner import paired_steps
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.pillar_projection import Pillars
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.step import PreparedFrame
from bevcli.registry import load
from bevcli.sequences.images import AT_REST
from bevcli.sequences.open import open_sequence, select_range
from bevcli.workshop.engines.box_differences import BoxDifferences, box_differences
from bevcli.workshop.engines.engine import Engine
from bevcli.workshop.engines.engine_choice import EngineChoice, fastest_engine
from bevcli.workshop.engines.export_onnx import export_onnx
from bevcli.workshop.engines.exported import ExportedModel
from bevcli.workshop.engines.file_cache import EngineFile, FileFacts
from bevcli.workshop.engines.options import OnnxOptions
from bevcli.workshop.engines.quantize import quantize

FORMAT = 1  # of the files in the cache; increase it when they change in one version of bevcli
KEY_DIGITS = 20
CALIBRATION_FRAMES = 16
COMPARED_FRAMES = 8
Item = TypeVar("Item")
Report = Callable[[int, int, str], None]  # steps done, steps in all, what is done


def in_engine(
    model: Model,
    rig: CameraRig,
    drive: Sequence | None = None,
    *,
    parts: str = "",
    report: Report = lambda done, total, what: None,
) -> Model:
    """The model in the engine that it was loaded for. A model that runs in PyTorch is returned as it is.

    The first call exports the model for the number of cameras and the image size of the rig, calibrates INT8 on the
    first frames of a drive, and compares the boxes with those in PyTorch. The file is kept in the user's cache.

    Args:
        model: of `load_model`.
        rig: that it is to run on.
        drive: whose first frames are used; None where there are no frames yet.
        parts: what looks into the network, such as "`probes`", which only PyTorch has: AUTO is PyTorch then.
        report: called before the first step of the work, and after each.

    Raises:
        BevcliError: `parts` are asked for in another engine, or the engine is not installed.
        InputError: there are no frames to calibrate with, or a frame cannot be read.
        OutputError: the cache cannot be written.
    """
    if parts:
        model.require_parts(parts)
    if model.choice is None:
        return model
    engine = TORCH if parts else model.choice.resolve(model.config)
    choice, model = model.choice, replace(model, choice=None)
    if engine == TORCH:
        return replace(model, engine_note=f"engine {choice.engine} is torch: {_why_torch(model, parts)}")
    making = _Making(model, rig, drive, choice, engine, report)
    network, facts = making.file(choice.precision)
    if making.done:
        report(making.total, making.total, "kept")
    return replace(
        model,
        network=network,
        engine=engine,
        precision=choice.precision,
        file=network.file,
        engine_note=f"engine {engine}, {choice.precision}{_cost(facts, engine)}; the exported file is {network.file}",
    )


def _why_torch(model: Model, parts: str) -> str:
    if parts:
        return f"{parts} need it"
    measured = fastest_engine(model.config, "fp32")
    if measured == TORCH:
        return "the fastest one here by `bevcli bench --engines`"
    if measured is not None:
        return f"{measured}, the fastest one, is no longer installed"
    return f"no engine was measured here: `bevcli bench --engines --model {model.name}` does"


def _cost(facts: FileFacts, engine: str) -> str:
    calibrated = f", calibrated with {facts.calibrated_with}" if facts.calibrated_with else ""
    found = facts.differences.get(engine)
    return calibrated + ("" if found is None else f"; against PyTorch in fp32: {found.text()}")


@dataclass
class _Making:
    """The files of a model for a rig, and the progress of making them."""

    model: Model
    rig: CameraRig
    drive: Sequence | None
    choice: EngineChoice
    engine: str
    report: Report
    done: int = 0

    def __post_init__(self) -> None:
        self.sized = self.model.for_rig(self.rig)
        kind: type[Engine] = load("bevcli.engines", self.engine)
        deformable = any(isinstance(each, ModulatedDeformableConvolution) for each in self.model.network.modules())
        pose = Pose.identity()
        still = Frame(FrameStamp(0, "", 0), self.rig, {}, pose, dict.fromkeys(self.rig.names, pose), AT_REST)
        frame = Preprocessor(self.sized.config)(still)  # without images
        self.options = OnnxOptions(
            deformable_convolution=kind.deformable_convolution if deformable else OnnxOptions.deformable_convolution,
            cameras=frame.images.shape[1],
            cameras_per_cell=_cameras_per_cell(frame, self.sized),
        )

    def file(self, precision: str) -> tuple[ExportedModel, FileFacts]:
        """The file in a precision, from the cache or made now, and its facts."""
        file = EngineFile(self._key(precision, CALIBRATION_FRAMES))  # perhaps of an earlier, longer drive
        if not file.stamp:
            frames = CALIBRATION_FRAMES if self.first_frames is None else len(self.first_frames.stamps)
            file = EngineFile(self._key(precision, frames))  # of a short drive, which longer ones do not use
        network, facts = _load(file, self.engine, file.stamp) or self._make(file, precision)
        is_new = self.engine not in facts.differences and precision == self.choice.precision
        if is_new and self.first_frames is not None:
            found = {**facts.differences, self.engine: self._compare(network, self.first_frames)}
            facts = msgspec.structs.replace(facts, differences=found)
            file.state(facts)
        return network, facts

    def _make(self, file: EngineFile, precision: str) -> tuple[ExportedModel, FileFacts]:
        if precision == "fp32":
            return file.make(self._export, "", self.engine)
        exact, drive = self.file("fp32")[0], self.first_frames
        if drive is None:
            raise InputError("`precision=int8`: there are no frames to calibrate with: pass `calibrate_with=DRIVE`")
        images = calibration_images(self.sized.config, exact.cameras, [drive], CALIBRATION_FRAMES)
        counted = self._counted(f"calibrating {self.model.name} with {drive.name}", images)
        made = file.make(lambda path: quantize(exact.file, counted, path), drive.name, self.engine)
        self._tell("calibrated", 1)
        return made

    def _key(self, precision: str, frames: int) -> str:
        other = self.choice.calibrate_with if precision == "int8" else None
        facts = {
            "version": (__version__, FORMAT),
            "weights": self.model.weights_hash,
            "model": self.sized.config_hash,
            "labels": (self.model.untrained, self.model.bundled),
            "options": repr(self.options),
            "precision": precision,
            "calibration": (frames if precision == "int8" else 0, None if other is None else str(other.resolve())),
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]

    def _export(self, path: Path) -> None:
        self._tell(f"exporting {self.model.name} for {self.options.cameras} cameras to {self.engine}")
        model, contents = self.model, self.sized.contents()
        export_onnx(
            self.sized.network, path, self.options, contents=contents, untrained=model.untrained, bundled=model.bundled
        )
        self._tell("exported", 1)

    @cached_property
    def first_frames(self) -> Sequence | None:
        """The frames that calibrate and are compared; None where there is no drive. Raises InputError."""
        drive = self.drive
        if self.choice.calibrate_with is not None:
            rate_hz = self.model.config.rate_hz
            drive = open_sequence(self.choice.calibrate_with, rate_hz=rate_hz, ground_truth=False)
        return None if drive is None else select_range(drive, slice(0, CALIBRATION_FRAMES))

    @property
    def total(self) -> int:
        """The steps of the work: the export, each frame that is compared, each that calibrates, and the INT8 file."""
        frames = 0 if self.first_frames is None else len(self.first_frames.stamps)
        return 1 + min(frames, COMPARED_FRAMES) + (1 + frames if self.choice.precision == "int8" else 0)

    def _compare(self, network: ExportedModel, drive: Sequence) -> BoxDifferences:
        plain = prepare_for_inference(self.sized.network, torch.device("cpu"))
        preprocess = Preprocessor(self.sized.config)
        frames = (preprocess(drive.load(place)) for place in range(min(COMPARED_FRAMES, len(drive.stamps))))
        steps = paired_steps(plain, network, self._counted(f"comparing {self.engine} with PyTorch", frames))
        return box_differences((ours, theirs) for _, ours, theirs in steps)

    def _counted(self, what: str, items: Iterator[Item]) -> Iterator[Item]:
        """The items, each of which is reported as a step."""
        self._tell(what)
        for item in items:
            yield item
            self._tell(what, 1)

    def _tell(self, what: str, steps: int = 0) -> None:
        self.done += steps
        self.report(self.done, self.total, what)


@lru_cache(maxsize=1)
def _load(file: EngineFile, engine: str, stamp: object) -> tuple[ExportedModel, FileFacts] | None:
    """A file of the cache in an engine; the last one is kept for the next drive. stamp: of the file."""
    return file.load(engine)


def _cameras_per_cell(frame: PreparedFrame, model: Model) -> int:
    """The largest number of cameras of a rig that see one cell; at least the default."""
    everywhere = torch.ones_like(frame.has_image)
    height, width = frame.images.shape[-2:]
    hit = Pillars(model.config.bev_grid).project(frame.image_from_bev.float(), (height, width), everywhere).hit
    return max(int(hit.sum(1).max()), OnnxOptions.cameras_per_cell)
