"""`exported_for_rig`: a model that is named, as an exported file for a rig, made once and kept in the user's cache.

The files lie in $XDG_CACHE_HOME/bevcli/engines (default ~/.cache/bevcli/engines). A file is written aside and renamed,
so that several processes may make it at the same time. Files that nobody has used for some months are removed.
"""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import torch

from bevcli._version import __version__
from bevcli.errors import ConfigError, InputError, WeightsError
from bevcli.frame import Frame, FrameStamp, Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose
from bevcli.inference.load import Model, Report
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner, RunnerState
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.pillar_projection import Pillars
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import TemporalModel
from bevcli.parsing.files import MIB, read_bytes
from bevcli.sequences.images import AT_REST
from bevcli.sequences.open import open_sequence, select_range
from bevcli.user_folders import user_cache
from bevcli.workshop.engines.export_onnx import calibration_images, export_onnx, quantize
from bevcli.workshop.engines.exported import ExportedModel
from bevcli.workshop.engines.options import OnnxOptions
from bevcli.writing import whole_file, write_whole

FORMAT = 1  # of the files in the cache; increase it when they change in one version of bevcli
KEY_DIGITS = 20
UNUSED_S = 90 * 24 * 3600.0
CALIBRATION_FRAMES = 16
COMPARED_FRAMES = 8
SHOWN = 0.25  # boxes with a lower score are not shown by default
NEAR_M = 0.1
CENTER = (0, 1, 4)  # columns of box codes
Item = TypeVar("Item")
Open = Callable[[Path], ExportedModel]


def exported_for_rig(
    model: Model,
    rig: CameraRig,
    drive: Sequence | None,
    report: Report,
    open_file: Open,
    deformable_convolution: Literal["operator", "gridsample"],
) -> Model:
    """A model in the engine that it was loaded for. Arguments and errors as for `Model.in_engine`.

    open_file: of the engine. deformable_convolution: of a file for it, see `OnnxOptions`.
    """
    export = _Export(model, rig, drive, report, open_file, deformable_convolution)
    network, facts = export.file(model.precision)
    if export.done:
        report(export.total, export.total, "kept")
    calibrated = f", calibrated with {facts.calibrated_with}" if facts.calibrated_with else ""
    differences = facts.differences.get(model.engine)
    compared = "" if differences is None else f"; against PyTorch in fp32: {differences.text()}"
    note = f"engine {model.engine}, {model.precision}{calibrated}{compared}; the exported file is {network.file}"
    return replace(model, network=network, file=network.file, engine_note=note)


class BoxDifferences(msgspec.Struct, frozen=True):
    """Differences of an exported file from the model in PyTorch and float32, over the boxes that this shows.

    Attributes:
        frames: number of frames that were compared.
        boxes: number of boxes.
        near: share of them whose centres differ by at most 0.1 m, 0 to 1.
        median_m: median of the distances of the centres, metres.
        largest_m: the largest of them.
        score: the largest difference of their scores.
    """

    frames: int
    boxes: int
    near: float
    median_m: float
    largest_m: float
    score: float

    def text(self) -> str:
        """One line."""
        if not self.boxes:
            return f"no boxes to compare in {self.frames} frames"
        return (
            f"{self.boxes} boxes in {self.frames} frames: centres differ by {self.median_m:.2g} m in the median and "
            f"{self.largest_m:.2g} m at most, {self.near:.1%} by at most 0.1 m; scores by at most {self.score:.2g}"
        )


def box_differences(steps: Iterable[tuple[ModelOutputs, ModelOutputs]]) -> BoxDifferences:
    """The differences over some frames. steps: outputs in PyTorch and of the file, whose queries are the same ones."""
    distances, scores, frames = [torch.zeros(0)], [torch.zeros(0)], 0
    for ours, theirs in steps:
        frames += 1
        ours_scores, theirs_scores = ours.class_logits[-1, 0].sigmoid(), theirs.class_logits[-1, 0].sigmoid()
        shown = ours_scores.amax(-1) >= SHOWN  # (Q,)
        moved = (ours.box_codes[-1, 0] - theirs.box_codes[-1, 0])[shown][:, CENTER]
        distances.append(moved.norm(dim=-1).cpu())
        scores.append((ours_scores - theirs_scores)[shown].abs().amax(-1).cpu())
    metres, off = torch.cat(distances), torch.cat(scores)
    if not len(metres):
        return BoxDifferences(frames, 0, 1.0, 0.0, 0.0, 0.0)
    near = (metres <= NEAR_M).float().mean()
    return BoxDifferences(frames, len(metres), *(float(x) for x in (near, metres.median(), metres.max(), off.max())))


class FileFacts(msgspec.Struct, frozen=True):
    """The facts of a file.

    Attributes:
        sha256: of the file, hexadecimal.
        calibrated_with: name of the drive whose frames calibrated it; "" for float32.
        differences: by engine.
    """

    sha256: str
    calibrated_with: str = ""
    differences: Mapping[str, BoxDifferences] = {}


@dataclass(frozen=True)
class CachedFile:
    """A file of the cache. key: hash of everything that its contents depend on."""

    key: str

    @property
    def path(self) -> Path:
        """The exported file."""
        return cache_folder() / f"{self.key}.onnx"

    @property
    def stamp(self) -> tuple[object, ...]:
        """Inodes and sizes of the file and its facts, which change with them; empty where one is missing."""
        try:
            stats = [path.stat() for path in (self.path, self._facts)]
        except OSError:
            return ()
        return (self.path, *((stat.st_ino, stat.st_size) for stat in stats))

    def load(self, open_file: Open) -> tuple[ExportedModel, FileFacts] | None:
        """The file in an engine, and its facts; None if it is not there, or broken.

        Raises BevcliError where the engine is not installed.
        """
        try:
            facts = msgspec.json.decode(read_bytes(self._facts, MIB, error=WeightsError), type=FileFacts)
            network = open_file(self.path)
        except (msgspec.MsgspecError, ValueError, RecursionError, WeightsError, ConfigError):
            return None
        if bytes(network.digest.tolist()).hex() != facts.sha256:
            return None
        with suppress(OSError):  # a cache that cannot be written can be read
            os.utime(self.path)
        return network, facts

    def make(
        self, write: Callable[[Path], None], calibrated_with: str, open_file: Open
    ) -> tuple[ExportedModel, FileFacts]:
        """Write the file, and load it. Raises OutputError, and what `write` raises."""
        _remove_unused(self.path.parent)
        with whole_file(self.path, parents=True, shared=True) as unfinished:
            write(unfinished)
        network = open_file(self.path)
        facts = FileFacts(bytes(network.digest.tolist()).hex(), calibrated_with)
        self.store_facts(facts)
        return network, facts

    def store_facts(self, facts: FileFacts) -> None:
        """Write the facts. Raises OutputError."""
        write_whole(self._facts, msgspec.json.encode(facts), shared=True)

    @property
    def _facts(self) -> Path:
        return self.path.with_suffix(".json")


def cache_folder() -> Path:
    """The folder of exported files."""
    return user_cache() / "engines"


def _remove_unused(folder: Path) -> None:
    """Remove files that were not used for a long time."""
    for path in folder.glob("*.onnx") if folder.is_dir() else ():
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > UNUSED_S:
                path.unlink()
                path.with_suffix(".json").unlink(missing_ok=True)


@lru_cache(maxsize=1)
def _load(file: CachedFile, open_file: Open, stamp: object) -> tuple[ExportedModel, FileFacts] | None:
    """A file of the cache in an engine; the last one is kept for the next drive. stamp: of the file."""
    return file.load(open_file)


@dataclass
class _Export:
    """The files of a model for a rig, and the progress of making them."""

    model: Model
    rig: CameraRig
    drive: Sequence | None
    report: Report
    open_file: Open
    deformable_convolution: Literal["operator", "gridsample"]
    done: int = 0

    @cached_property
    def sized(self) -> Model:
        """The model with the image size of the rig."""
        return self.model.for_rig(self.rig)

    @cached_property
    def options(self) -> OnnxOptions:
        deformable = any(isinstance(each, ModulatedDeformableConvolution) for each in self.model.network.modules())
        pose = Pose.identity()
        still = Frame(FrameStamp(0, "", 0), self.rig, {}, pose, dict.fromkeys(self.rig.names, pose), AT_REST)
        frame = Preprocessor(self.sized.config)(still)  # without images
        return OnnxOptions(
            deformable_convolution=self.deformable_convolution if deformable else OnnxOptions.deformable_convolution,
            cameras=frame.images.shape[1],
            cameras_per_cell=_cameras_per_cell(frame, self.sized),
        )

    def file(self, precision: str) -> tuple[ExportedModel, FileFacts]:
        """The file in a precision, from the cache or made now, and its facts."""
        file = CachedFile(self._key(precision, CALIBRATION_FRAMES))  # perhaps of an earlier, longer drive
        if not file.stamp:
            frames = CALIBRATION_FRAMES if self.first_frames is None else len(self.first_frames.stamps)
            file = CachedFile(self._key(precision, frames))  # of a short drive, which longer ones do not use
        network, facts = _load(file, self.open_file, file.stamp) or self._make(file, precision)
        engine, is_asked = self.model.engine, precision == self.model.precision
        if is_asked and engine not in facts.differences and self.first_frames is not None:
            differences = {**facts.differences, engine: self._compare(network, self.first_frames)}
            facts = msgspec.structs.replace(facts, differences=differences)
            file.store_facts(facts)
        return network, facts

    def _make(self, file: CachedFile, precision: str) -> tuple[ExportedModel, FileFacts]:
        if precision == "fp32":
            return file.make(self._export, "", self.open_file)
        exact, drive = self.file("fp32")[0], self.first_frames
        if drive is None:
            raise InputError("`precision=int8`: there are no frames to calibrate with: pass `calibrate_with=DRIVE`")
        images = calibration_images(self.sized.config, exact.cameras, [drive], CALIBRATION_FRAMES)
        counted = self._counted(f"calibrating {self.model.name} with {drive.name}", images)
        made = file.make(lambda path: quantize(exact.file, counted, path), drive.name, self.open_file)
        self._tell("calibrated", 1)
        return made

    def _key(self, precision: str, frames: int) -> str:
        other = self.model.calibrate_with if precision == "int8" else None
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
        self._tell(f"exporting {self.model.name} for {self.options.cameras} cameras to {self.model.engine}")
        model, contents = self.model, self.sized.contents()
        export_onnx(
            self.sized.network, path, self.options, contents=contents, untrained=model.untrained, bundled=model.bundled
        )
        self._tell("exported", 1)

    @cached_property
    def first_frames(self) -> Sequence | None:
        """The frames that calibrate and are compared; None where there is no drive. Raises InputError."""
        drive = self.drive
        if self.model.calibrate_with is not None:
            rate_hz = self.model.config.rate_hz
            drive = open_sequence(self.model.calibrate_with, rate_hz=rate_hz, ground_truth=False)
        return None if drive is None else select_range(drive, slice(0, CALIBRATION_FRAMES))

    @property
    def total(self) -> int:
        """The steps of the work: the export, each frame that is compared, each that calibrates, and the INT8 file."""
        frames = 0 if self.first_frames is None else len(self.first_frames.stamps)
        return 1 + min(frames, COMPARED_FRAMES) + (1 + frames if self.model.precision == "int8" else 0)

    def _compare(self, network: ExportedModel, drive: Sequence) -> BoxDifferences:
        plain = prepare_for_inference(self.sized.network, torch.device("cpu"))
        preprocess = Preprocessor(self.sized.config)
        frames = (preprocess(drive.load(index)) for index in range(min(COMPARED_FRAMES, len(drive.stamps))))
        steps = paired_steps(plain, network, self._counted(f"comparing {self.model.engine} with PyTorch", frames))
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


def _cameras_per_cell(frame: PreparedFrame, model: Model) -> int:
    """The largest number of cameras of a rig that see one cell; at least the default."""
    everywhere = torch.ones_like(frame.has_image)
    height, width = frame.images.shape[-2:]
    hit = Pillars(model.config.bev_grid).project(frame.image_from_bev.float(), (height, width), everywhere).hit
    return max(int(hit.sum(1).max()), OnnxOptions.cameras_per_cell)


def paired_steps(
    one: TemporalModel, other: TemporalModel, frames: Iterable[PreparedFrame]
) -> Iterator[tuple[PreparedFrame, ModelOutputs, ModelOutputs]]:
    """Step two versions of a model on the CPU over the same frames, each with its own history.

    Yields each frame that has an image, and the outputs of both.
    """
    runners = [Runner(network, torch.device("cpu")) for network in (one, other)]
    states: list[RunnerState[Any]] = [RunnerState(), RunnerState()]
    outputs: dict[Runner, ModelOutputs] = {}  # of the last step of each
    with contextlib.ExitStack() as hooks:
        for runner in runners:
            hook = runner.model.register_forward_hook(lambda *call, of=runner: outputs.update({of: call[2]}))
            hooks.enter_context(hook)
        for prepared in frames:
            if prepared.frame.images:
                states = [runner.step(state, prepared)[0] for runner, state in zip(runners, states, strict=True)]
                yield prepared, outputs[runners[0]], outputs[runners[1]]
