"""calibration.json: the rig's cameras, and the frame that the model predicts in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bevcli.errors import InputError, OutputError
from bevcli.findings import Finding, errors_of
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.sequences.files.field_report import Report
from bevcli.sequences.files.pose_field import parse_transform, transform_to_json
from bevcli.sequences.native.calibration_fields import parse_camera

FORMAT = "bevcli-calibration/1"


@dataclass(frozen=True)
class RigDraft:
    """A calibration read as far as it can be.

    rig: the cameras of which every field could be used, maybe none; rotations that were none are the nearest ones.
    findings: what is wrong with the file itself. What the file says may still be implausible: see rig_checks.
    """

    rig: CameraRig
    findings: tuple[Finding, ...]


def read_calibration(path: Path) -> CameraRig:
    """The rig in calibration.json. Raises InputError with the first mistake in it."""
    draft = draft_calibration(path)
    for error in errors_of(draft.findings):
        raise InputError(f"{path}: {error.line}")
    return draft.rig


def draft_calibration(path: Path) -> RigDraft:
    """The rig in calibration.json with all mistakes in it. Raises InputError only where it is no JSON object."""
    document = _load_object(path)
    report = Report()
    if "format" not in document:
        report.missing("format", FORMAT)
    elif document["format"] != FORMAT:
        report.error("wrong-format", "format", "is not the one that is read", expected=FORMAT, found=document["format"])
    cameras = _parse_cameras(document, report)
    given = "ego_from_bev" in document
    ego_from_bev = parse_transform(document, "ego_from_bev", report) if given else None
    if ego_from_bev is None:
        ego_from_bev = default_ego_from_bev()
    return RigDraft(CameraRig(cameras, ego_from_bev, ego_from_bev_assumed=not given), tuple(report.findings))


def write_calibration(path: Path, rig: CameraRig) -> None:
    """Write the rig so that `read_calibration` gives the same numbers to the last bit. Raises OutputError.

    An assumed `ego_from_bev` is left out, so that it is still known to be assumed.
    """
    document: dict[str, Any] = {"format": FORMAT}
    if not rig.ego_from_bev_assumed:
        document["ego_from_bev"] = transform_to_json(rig.ego_from_bev)
    document["cameras"] = {camera.name: _camera_to_json(camera) for camera in rig.cameras}
    try:
        path.write_text(_lines(document) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _load_object(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file (expected a calibration.json)") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text: {error}") from error
    try:
        document = json.loads(text, object_pairs_hook=lambda pairs: _unique(pairs, path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: line {error.lineno}, column {error.colno}: broken JSON: {error.msg}") from error
    if not isinstance(document, dict):
        raise InputError(f'{path}: is no JSON object (expected {{"format": "{FORMAT}", "cameras": {{...}}}})')
    return document


def _unique(pairs: list[tuple[str, Any]], path: Path) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f'{path}: "{key}" stands twice in the same object: remove or rename one')
    return dict(pairs)


def _parse_cameras(document: Mapping[str, Any], report: Report) -> tuple[Camera, ...]:
    value = document.get("cameras")
    if value is None:
        report.missing("cameras", "an object with one entry a camera")
        return ()
    if not isinstance(value, dict) or not value:
        message = "names no camera"
        report.error("wrong-shape", "cameras", message, expected="an object with one entry a camera", found=value)
        return ()
    parsed = (parse_camera(name, entry, report.about(name)) for name, entry in value.items())
    return tuple(camera for camera in parsed if camera is not None)


def _camera_to_json(camera: Camera) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": camera.intrinsics.tolist(),
        "ego_from_camera": transform_to_json(camera.ego_from_camera),
    }
    if camera.distortion is not None:
        lens = camera.distortion
        entry["distortion"] = {"model": lens.model, "coefficients": list(lens.coefficients)}
    return entry


def _lines(value: Any, indent: str = "") -> str:
    """JSON with objects spread over lines and lists kept on one, as a person would write it."""
    if not isinstance(value, dict):
        return json.dumps(value)
    inner = indent + "  "
    entries = (f"{inner}{json.dumps(key)}: {_lines(entry, inner)}" for key, entry in value.items())
    return "{\n" + ",\n".join(entries) + f"\n{indent}}}"
