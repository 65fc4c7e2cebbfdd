"""calibration.json: the cameras of the rig, the bev frame in which the model predicts, and facts of the drive."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bevcli.errors import InputError, OutputError
from bevcli.findings import Finding, errors_of
from bevcli.frame import DriveFacts
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.geographic import EAST_DEG, GeoOrigin
from bevcli.sequences.files.camera_fields import parse_camera
from bevcli.sequences.files.json_fields import Report, parse_numbers
from bevcli.sequences.files.transform_json import parse_transform, transform_to_json

FORMAT = "bevcli-calibration/1"


@dataclass(frozen=True)
class RigDraft:
    """A calibration with mistakes.

    Attributes:
        rig: the cameras with usable fields, possibly none. Invalid rotations are replaced by the nearest valid ones.
        findings: what is wrong with the file. Whether its numbers are plausible is checked in `bevcli.rig`.
        facts: what the file states about the drive.
    """

    rig: CameraRig
    findings: tuple[Finding, ...]
    facts: DriveFacts = field(default_factory=DriveFacts)


def read_calibration(path: Path) -> CameraRig:
    """The rig in calibration.json. Raises InputError with the first mistake in the file."""
    return _without_errors(path).rig


def read_facts(path: Path) -> DriveFacts:
    """What calibration.json states about the drive. Raises InputError with the first mistake in the file."""
    return _without_errors(path).facts


def _without_errors(path: Path) -> RigDraft:
    draft = draft_calibration(path)
    for error in errors_of(draft.findings):
        raise InputError(f"{path}: {error.line}")
    return draft


def draft_calibration(path: Path) -> RigDraft:
    """The rig in calibration.json and all mistakes in the file. Raises InputError only if it is not a JSON object."""
    document = _load_object(path)
    report = Report()
    if "format" not in document:
        report.missing("format", FORMAT)
    elif document["format"] != FORMAT:
        report.error("wrong-format", "format", "is not supported", expected=FORMAT, found=document["format"])
    cameras = _parse_cameras(document, report)
    given = "ego_from_bev" in document
    ego_from_bev = parse_transform(document, "ego_from_bev", report) if given else None
    if ego_from_bev is None:
        ego_from_bev = default_ego_from_bev()
    facts = _parse_facts(document, report)
    return RigDraft(CameraRig(cameras, ego_from_bev, ego_from_bev_assumed=not given), tuple(report.findings), facts)


def write_calibration(path: Path, rig: CameraRig, facts: DriveFacts | None = None) -> None:
    """Write the rig so that `read_calibration` returns exactly the same numbers. Raises OutputError.

    A default `ego_from_bev` is left out, so that a reader also knows it as the default.
    """
    document: dict[str, Any] = {"format": FORMAT, **({} if facts is None else _facts_to_json(facts))}
    if not rig.ego_from_bev_assumed:
        document["ego_from_bev"] = transform_to_json(rig.ego_from_bev)
    document["cameras"] = {camera.name: _camera_to_json(camera) for camera in rig.cameras}
    try:
        path.write_text(_lines(document) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error


def _load_object(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InputError(f"{path}: the file is missing (expected a calibration)") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from error
    try:
        document = json.loads(text, object_pairs_hook=lambda pairs: _unique(pairs, path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: line {error.lineno}, column {error.colno}: broken JSON: {error.msg}") from error
    if not isinstance(document, dict):
        raise InputError(f'{path}: is not a JSON object (expected {{"format": "{FORMAT}", "cameras": {{...}}}})')
    return document


def _unique(pairs: list[tuple[str, Any]], path: Path) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f'{path}: "{key}" appears twice in the same object: remove or rename one')
    return dict(pairs)


def _parse_cameras(document: Mapping[str, Any], report: Report) -> tuple[Camera, ...]:
    value = document.get("cameras")
    if value is None:
        report.missing("cameras", "an object with one entry per camera")
        return ()
    if not isinstance(value, dict) or not value:
        message = "contains no camera"
        report.error("wrong-shape", "cameras", message, expected="an object with one entry per camera", found=value)
        return ()
    parsed = (parse_camera(name, entry, report.about(name)) for name, entry in value.items())
    return tuple(camera for camera in parsed if camera is not None)


def _parse_facts(document: Mapping[str, Any], report: Report) -> DriveFacts:
    rendered = document.get("rendered", False)
    if not isinstance(rendered, bool):
        report.error("wrong-shape", "rendered", "is not true or false", expected="true or false", found=rendered)
    return DriveFacts(rendered is True, _parse_geo_origin(document, report))


def _parse_geo_origin(document: Mapping[str, Any], report: Report) -> GeoOrigin | None:
    value = document.get("geo_origin")
    if value is None:
        return None
    expected = '{"latitude": 48.137, "longitude": 11.575, "heading_deg": 90}'
    if not isinstance(value, dict):
        report.error("wrong-shape", "geo_origin", "is not an object", expected=expected, found=value)
        return None
    within = report.within("geo_origin")
    limits = {"latitude": 90.0, "longitude": 180.0, "heading_deg": 360.0}
    numbers = []
    for name, limit in limits.items():
        given = {name: [value[name]] if name in value else [EAST_DEG] if name == "heading_deg" else None}
        number = parse_numbers(given, name, (1,), within)
        if number is not None and abs(number[0]) > limit:
            wanted = f"degrees, -{limit:g} to {limit:g}"
            within.error("wrong-size", name, "is out of range", expected=wanted, found=value[name])
            number = None
        numbers.append(number)
    if any(number is None for number in numbers):
        return None
    return GeoOrigin(*(float(number[0]) for number in numbers if number is not None))


def _facts_to_json(facts: DriveFacts) -> dict[str, Any]:
    document: dict[str, Any] = {"rendered": True} if facts.rendered else {}
    if facts.geo_origin is not None:
        origin = facts.geo_origin
        document["geo_origin"] = {
            "latitude": origin.latitude_deg,
            "longitude": origin.longitude_deg,
            "heading_deg": origin.heading_deg,
        }
    return document


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
    """JSON with one line per object member, and each list on one line."""
    if not isinstance(value, dict):
        return json.dumps(value)
    inner = indent + "  "
    entries = (f"{inner}{json.dumps(key)}: {_lines(entry, inner)}" for key, entry in value.items())
    return "{\n" + ",\n".join(entries) + f"\n{indent}}}"
