"""`exported_for_rig`: a model that is named, as an exported file for a rig, made once and kept in the user's cache.

The files lie in $XDG_CACHE_HOME/bevcli/engines (default ~/.cache/bevcli/engines). A file is written aside and renamed,
so that several processes may make it at the same time. Files that nobody has used for some months are removed.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import msgspec
import torch

from bevcli._version import __version__
from bevcli.errors import ConfigError, InputError, WeightsError
from bevcli.frame import Frame, FrameStamp, Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose
from bevcli.inference.load import Model
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.pillar_projection import Pillars
from bevcli.model.step import PreparedFrame
from bevcli.parsing.files import MIB, read_bytes
from bevcli.sequences.images import AT_REST
from bevcli.sequences.open import open_sequence, select_range
from bevcli.workshop.engines.export_onnx import calibration_images, export_onnx, quantize
from bevcli.workshop.engines.export_step import DeformableConvolution
from bevcli.workshop.engines.exported import ExportedModel
from bevcli.workshop.engines.options import OnnxOptions
from bevcli.writing import user_cache, whole_file, write_whole

FORMAT = 1  # of the files in the cache; increase it when they change in one version of bevcli
KEY_DIGITS = 20
UNUSED_S = 90 * 24 * 3600.0
CALIBRATION_FRAMES = 16
ONCE = "once for these weights, number of cameras and image size"
Open = Callable[[Path], ExportedModel]


def exported_for_rig(
    model: Model,
    rig: CameraRig,
    drive: Sequence | None,
    report: Callable[[str], None],
    open_file: Open,
    deformable_convolution: DeformableConvolution,
) -> Model:
    """A model in the engine that it was loaded for. Arguments and errors as for `Model.in_engine`.

    open_file: of the engine. deformable_convolution: of a file for it, see `OnnxOptions`.
    """
    sized = model.for_rig(rig)
    options = _options(sized, rig, deformable_convolution)
    exact = CachedFile(_key(sized, options, "fp32"))

    def export(path: Path) -> str:
        report(f"exporting {model.name} for {options.cameras} cameras to {model.engine}, {ONCE}")
        labels = {"untrained": model.untrained, "bundled": model.bundled}
        export_onnx(sized.network, path, options, contents=sized.contents(), **labels)
        return ""

    def calibrate(path: Path) -> str:
        frames = _calibration_frames(model, drive)
        network, _ = exact.get(open_file, export)
        report(f"calibrating {model.name} with {frames.name}, {ONCE}")
        images = calibration_images(sized.config, network.cameras, [frames], CALIBRATION_FRAMES)
        quantize(network.file, images, path)
        return frames.name

    if model.precision == "fp32":
        network, calibrated_with = exact.get(open_file, export)
    else:
        file = CachedFile(_key(sized, options, "int8", CALIBRATION_FRAMES))  # perhaps of an earlier, longer drive
        if not file.stamp:  # then of this drive: longer ones do not use the file of a short one
            file = CachedFile(_key(sized, options, "int8", len(_calibration_frames(model, drive).stamps)))
        network, calibrated_with = file.get(open_file, calibrate)
    calibrated = f", calibrated with {calibrated_with}" if calibrated_with else ""
    note = f"engine {model.engine}, {model.precision}{calibrated}; the exported file is {network.file}"
    return replace(model, network=network, file=network.file, engine_note=note)


def _calibration_frames(model: Model, drive: Sequence | None) -> Sequence:
    if model.calibrate_with is not None:
        drive = open_sequence(model.calibrate_with, rate_hz=model.config.rate_hz, ground_truth=False)
    if drive is None:
        raise InputError("`precision=int8`: there are no frames to calibrate with: pass `calibrate_with=DRIVE`")
    return select_range(drive, slice(0, CALIBRATION_FRAMES))


def _key(sized: Model, options: OnnxOptions, precision: str, frames: int = 0) -> str:
    """Hash of all that a file depends on. frames: number of those that calibrate it."""
    other = sized.calibrate_with if precision == "int8" else None
    facts = {
        "version": (__version__, FORMAT),
        "weights": sized.weights_hash,
        "model": sized.config_hash,
        "labels": (sized.untrained, sized.bundled),
        "options": repr(options),
        "precision": precision,
        "calibration": (frames, None if other is None else str(other.resolve())),
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]


class FileFacts(msgspec.Struct, frozen=True):
    """The facts of a file: its SHA-256, hexadecimal, and the name of the drive that calibrated it, "" for float32."""

    sha256: str
    calibrated_with: str = ""


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

    def get(self, open_file: Open, write: Callable[[Path], str]) -> tuple[ExportedModel, str]:
        """The file in an engine, made where it is missing or broken, and the name of the drive that calibrated it.

        open_file: opens it in the engine. write: makes it, and returns that name.
        Raises BevcliError where the engine is not installed, OutputError, and what `write` raises.
        """
        loaded = _load(self, open_file, self.stamp)
        if loaded is not None:
            return loaded
        _remove_unused(self.path.parent)
        with whole_file(self.path, parents=True, shared=True) as unfinished:
            calibrated_with = write(unfinished)
        network = open_file(self.path)
        facts = FileFacts(bytes(network.digest.tolist()).hex(), calibrated_with)
        write_whole(self._facts, msgspec.json.encode(facts), shared=True)
        return network, calibrated_with

    def load(self, open_file: Open) -> tuple[ExportedModel, str] | None:
        """As `get`; None for a file that is missing or broken."""
        try:
            facts = msgspec.json.decode(read_bytes(self._facts, MIB, error=WeightsError), type=FileFacts)
            network = open_file(self.path)
        except (msgspec.MsgspecError, ValueError, RecursionError, WeightsError, ConfigError):
            return None
        if bytes(network.digest.tolist()).hex() != facts.sha256:
            return None
        with suppress(OSError):  # a cache that cannot be written can be read
            os.utime(self.path)
        return network, facts.calibrated_with

    @property
    def _facts(self) -> Path:
        return self.path.with_suffix(".json")


@lru_cache(maxsize=1)
def _load(file: CachedFile, open_file: Open, stamp: object) -> tuple[ExportedModel, str] | None:
    """A file of the cache in an engine; the last one is kept for the next drive. stamp: of the file."""
    return file.load(open_file) if stamp else None


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


def _options(sized: Model, rig: CameraRig, deformable_convolution: DeformableConvolution) -> OnnxOptions:
    deformable = any(isinstance(part, ModulatedDeformableConvolution) for part in sized.network.modules())
    pose = Pose.identity()
    still = Frame(FrameStamp(0, "", 0), rig, {}, pose, dict.fromkeys(rig.names, pose), AT_REST)
    frame = Preprocessor(sized.config)(still)  # without images
    return OnnxOptions(
        deformable_convolution=deformable_convolution if deformable else OnnxOptions.deformable_convolution,
        cameras=frame.images.shape[1],
        cameras_per_cell=_cameras_per_cell(frame, sized),
    )


def _cameras_per_cell(frame: PreparedFrame, model: Model) -> int:
    """The largest number of cameras of a rig that see one cell; at least the default."""
    everywhere = torch.ones_like(frame.has_image)
    height, width = frame.images.shape[-2:]
    hit = Pillars(model.config.bev_grid).project(frame.image_from_bev.float(), (height, width), everywhere).hit
    return max(int(hit.sum(1).max()), OnnxOptions.cameras_per_cell)
