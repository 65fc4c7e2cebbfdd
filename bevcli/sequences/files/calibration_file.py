"""calibration.json: the cameras of the rig, the bev frame in which the model predicts, and facts of the drive.

`draft_rig` reads calibrations of other programs too, by the wing `formats`.
"""

import json
from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import Finding, InputError, errors_of
from bevcli.frame import DriveFacts
from bevcli.geometry.cameras import Camera, CameraRig, Distortion, default_ego_from_bev
from bevcli.geometry.transforms import EAST_DEG, Array, GeoOrigin
from bevcli.options import named
from bevcli.parsing.documents import read_json
from bevcli.parsing.files import is_file_name
from bevcli.printing import one_line, quoted
from bevcli.sequences.files.json_fields import Report, parse_numbers, parse_transform, require, transform_to_json
from bevcli.sequences.files.readings import RigReading, question
from bevcli.sequences.options import RigOptions
from bevcli.writing import write_whole

FORMAT, CALIBRATION = "bevcli-calibration/1", "calibration.json"
LARGEST_BYTES = 4 << 20
LARGEST_JSON = 64 << 20  # of another program, such as that of a reconstruction
CONTRADICTED = "images-contradict"  # code of a finding about what the user states
# Options of a rig, beside its calibration.
OF_RIG = (
    "extrinsics",
    "fov_deg",
    "height",
    "yaw_deg",
    "transform",
    "rig_axes",
    "camera_axes",
    "rig_angles",
    "rig_unit",
)
KEYS = ("width", "height", "intrinsics", "distortion", "ego_from_camera")
LONGEST_NAME = 60  # characters of a wrong name in a message
LARGEST_SIZE = 16384  # pixels of a side
FOCAL_RANGE = (0.05, 50.0)  # focal length divided by image size, from extreme fisheye to extreme telephoto
ORIGIN_LIMITS = {"latitude": 90.0, "longitude": 180.0, "heading_deg": 360.0}  # in the order of GeoOrigin's fields
COEFFICIENT_COUNTS = {"brown_conrady": (4, 5, 8), "kannala_brandt": (4,)}


@dataclass(frozen=True)
class RigDraft:
    """A calibration with mistakes."""

    # the cameras with usable fields, possibly none. Invalid rotations are replaced by the nearest valid ones
    rig: CameraRig
    # what is wrong with the file. Whether its numbers are plausible is checked in `bevcli.rig`
    findings: tuple[Finding, ...]
    facts: DriveFacts = field(default_factory=DriveFacts)  # what the file states about the drive
    # what the poses in a file of another program may be, the rig being the first; empty where they are certain
    readings: tuple[RigReading, ...] = ()
    others: tuple[RigReading, ...] = ()  # readings that contradict what the user states
    file: Path = Path()  # of the poses

    @property
    def notes(self) -> tuple[str, ...]:
        """How the file was understood, if it is no calibration.json."""
        told = (each for each in self.findings if each.severity == "info" or each.code == CONTRADICTED)
        return tuple(finding.line for finding in told)

    def checked(self, path: Path) -> "RigDraft":
        """The draft itself. Raises InputError with its first mistake. path: the file."""
        for error in errors_of(self.findings):
            raise InputError(f"{path}: {error.line}")
        return self

    def certain(self) -> "RigDraft":
        """The draft itself. Raises InputError where its poses have several readings."""
        usual = [reading for reading in self.readings if reading.rank == self.readings[0].rank]
        if len(usual) > 1:
            raise question(self.file, "no images decide between them", usual)
        return self


def read_calibration(path: str | Path, drive: str | Path | None = None, **how: Any) -> CameraRig:
    """The rig in calibration.json, or in a calibration of another program (docs/other-inputs.md).

    drive: a folder or a video whose images state sizes that the calibration does not.
    how: options of a calibration of another program: `extrinsics`, `transform`, `height`, `rig_axes` and so on.
    Raises InputError with the first mistake in the file, and where its poses have several readings.
    """
    return draft_rig(Path(path), None if drive is None else Path(drive), **how).checked(Path(path)).certain().rig


def draft_rig(path: Path | None, drive: Path | None = None, **how: Any) -> RigDraft:
    """The rig in a calibration of any kind, and all mistakes of a calibration.json. Arguments as `read_calibration`.

    path: None for a rig of numbers alone (`fov_deg`). Raises InputError for a mistake in another file.
    """
    how = {name: value for name, value in how.items() if value is not None}
    file = None if path is None else _own_file(path)
    if file is None:
        from bevcli.workshop.formats.calibrations import read_rig

        return read_rig(path, drive, **how)
    for name in how:
        raise InputError(f"{file}: states all of the rig: remove {named(RigOptions, name)}")
    return draft_calibration(file)


def draft_of(options: RigOptions, drive: Path | None = None) -> RigDraft | None:
    """The rig of the files or numbers of the options, and how it was understood; None if none is given.

    drive: its images state missing sizes. Raises InputError.
    """
    if options.calibration is not None and options.intrinsics is not None:
        raise InputError(
            "`calibration` (`--calibration`) and `intrinsics` (`--intrinsics`) are the same: pass one of them"
        )
    how = {name: value for name in OF_RIG if (value := getattr(options, name)) is not None}
    path = options.intrinsics if options.calibration is None else options.calibration
    return None if path is None and not how else draft_rig(path, drive, **how).checked(path or Path())


def _own_file(path: Path) -> Path | None:
    """The calibration.json that a path is or contains; None for a calibration of another program."""
    if path.is_dir():
        return path / CALIBRATION if (path / CALIBRATION).exists() else None
    if path.suffix.lower() != ".json" or not path.exists():
        return path if path.name == CALIBRATION else None
    document = read_json(path, largest=LARGEST_JSON)
    is_own = not isinstance(document, (dict, list)) or "format" in document  # a list: cameras of another program
    return path if is_own or (path.name == CALIBRATION and "cameras" in document) else None


def draft_calibration(path: Path) -> RigDraft:
    """The rig in calibration.json and all mistakes in the file. Raises InputError only if it is not a JSON object."""
    missing = (
        "the file is missing (expected a calibration): pass `calibration` (`--calibration FILE`) of another kind, or "
        "`fov_deg=70` (`--fov 70`)"
    )
    document = read_json(path, largest=LARGEST_BYTES, missing=missing)
    if not isinstance(document, dict):
        raise InputError(f'{path}: is not a JSON object (expected {{"format": "{FORMAT}", "cameras": {{...}}}})')
    report = Report()
    if "format" not in document:
        report.missing("format", FORMAT)
    elif document["format"] != FORMAT:
        report.error("wrong-format", "format", "is not supported", expected=FORMAT, found=document["format"])
    entries, expected = document.get("cameras"), "an object with one entry per camera"
    drafts: list[Camera | None] = []
    if entries is None:
        report.missing("cameras", expected)
    elif not isinstance(entries, dict) or not entries:
        report.error("wrong-shape", "cameras", "contains no camera", expected=expected, found=entries)
    else:
        drafts = [parse_camera(name, entry, replace(report, camera=name)) for name, entry in entries.items()]
    cameras = tuple(camera for camera in drafts if camera is not None)
    is_given = "ego_from_bev" in document
    transform = parse_transform(document, "ego_from_bev", report) if is_given else None
    ego_from_bev = default_ego_from_bev() if transform is None else transform
    rendered = document.get("rendered", False)
    if not isinstance(rendered, bool):
        report.error("wrong-shape", "rendered", "is not true or false", expected="true or false", found=rendered)
    geo_origin = None if document.get("geo_origin") is None else _parse_geo_origin(document["geo_origin"], report)
    rig = CameraRig(cameras, ego_from_bev, ego_from_bev_assumed=not is_given)
    return RigDraft(rig, tuple(report.findings), DriveFacts(rendered is True, geo_origin))


def write_calibration(path: Path, rig: CameraRig, facts: DriveFacts = DriveFacts(), *, regular: bool = False) -> None:
    """Write the rig so that `read_calibration` returns exactly the same numbers. Raises OutputError.

    A default `ego_from_bev` is left out, so that a reader also knows it as the default. regular: see `whole_file`.
    """
    document: dict[str, Any] = {"format": FORMAT}
    if facts.rendered:
        document["rendered"] = True
    if facts.geo_origin is not None:
        document["geo_origin"] = dict(zip(ORIGIN_LIMITS, astuple(facts.geo_origin), strict=True))
    if not rig.ego_from_bev_assumed:
        document["ego_from_bev"] = transform_to_json(rig.ego_from_bev)
    document["cameras"] = {camera.name: camera_to_json(camera) for camera in rig.cameras}
    write_whole(path, f"{_lines(document)}\n".encode(), regular=regular)


def _parse_geo_origin(value: object, report: Report) -> GeoOrigin | None:
    if not isinstance(value, dict):
        expected = '{"latitude": 48.137, "longitude": 11.575, "heading_deg": 90}'
        report.error("wrong-shape", "geo_origin", "is not an object", expected=expected, found=value)
        return None
    inside, fields = replace(report, prefix="geo_origin."), {"heading_deg": EAST_DEG, **value}
    degrees: list[float] = []
    for name, limit in ORIGIN_LIMITS.items():
        number = parse_numbers({name: [fields[name]]} if name in fields else {}, name, (1,), inside)
        if number is not None and abs(number[0]) > limit:
            expected = f"degrees, -{limit:g} to {limit:g}"
            inside.error("wrong-size", name, "is out of range", expected=expected, found=quoted(fields[name]))
        elif number is not None:
            degrees.append(float(number[0]))
    return GeoOrigin(*degrees) if len(degrees) == len(ORIGIN_LIMITS) else None


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """The camera as calibration.json has it."""
    entry: dict[str, Any] = {
        "width": int(camera.width),  # a reader of another package may have NumPy's
        "height": int(camera.height),
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


def parse_camera(name: str, value: object, report: Report) -> Camera | None:
    """A camera of a calibration. All fields are read, so that all mistakes are reported."""
    if not is_file_name(name):
        expected = "up to 100 letters, digits and signs, no slash"
        name = one_line(name, LONGEST_NAME)
        report.error("camera-name", name, "is not the name of a camera", expected=expected)
        return None
    if not isinstance(value, dict):
        expected = "an object with " + ", ".join(KEYS)
        report.error("wrong-shape", name, "is not a camera", expected=expected, found=value)
        return None
    sizes: list[int] = []
    for side in ("width", "height"):
        size = value.get(side)
        if size is None:
            report.missing(side, "the image size in pixels")
        elif isinstance(size, bool) or not isinstance(size, int) or not 0 < size <= LARGEST_SIZE:
            expected = f"a positive integer, at most {LARGEST_SIZE}"
            report.error("wrong-size", side, "is not an image size", expected=expected, found=quoted(size))
        else:
            sizes.append(size)
    intrinsics = _parse_intrinsics(value, report)
    ego_from_camera = parse_transform(value, "ego_from_camera", report)
    distortion = None if value.get("distortion") is None else _parse_distortion(value["distortion"], report)
    if len(sizes) < 2 or intrinsics is None or ego_from_camera is None:
        return None
    width, height = sizes
    low, high = FOCAL_RANGE
    for axis, (letter, size) in enumerate((("x", width), ("y", height))):
        focal, center = intrinsics[axis, axis], intrinsics[axis, 2]
        if not low * size <= focal <= high * size:
            report.error(
                "intrinsics-absurd", "intrinsics", "has an implausible focal length",
                expected=f"{low * size:g} to {high * size:g} px for a size of {size}", found=f"f{letter} {focal:g}",
                advice="give it in pixels, not in millimetres",
            )  # fmt: skip
            return None
        if not -2 * size <= center <= 3 * size:
            expected, found = f"about {size / 2:g} px for a size of {size}", f"c{letter} {center:g}"
            message = "has its principal point far outside the image"
            report.error("intrinsics-absurd", "intrinsics", message, expected=expected, found=found)
            return None
    return Camera(name, width, height, intrinsics, ego_from_camera, distortion)


def checked_camera(camera: Camera, location: Path | str) -> Camera:
    """A camera that calibration.json may hold. where: start of an error message. Raises InputError for any other."""
    return require(parse_camera, camera.name, camera_to_json(camera), where=location, camera=camera.name)


def _parse_intrinsics(camera: Mapping[str, Any], report: Report) -> Array | None:
    """(3, 3) image_from_camera in pixels, upper triangular and not singular."""
    matrix = parse_numbers(camera, "intrinsics", (3, 3), report)
    if matrix is None:
        return None
    if not np.allclose(matrix[2], [0, 0, 1], atol=1e-9) or abs(matrix[1, 0]) > 1e-9:
        report.error(
            "intrinsics-form", "intrinsics", "is not a camera matrix",
            expected="[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]", found=matrix.tolist(),
            advice="write it row by row and scale it so that the last number is 1",
        )  # fmt: skip
        return None
    fx, fy = matrix[0, 0], matrix[1, 1]
    if min(fx, fy) <= 0:
        message, found = "is singular or mirrors the image", f"fx {fx:g}, fy {fy:g}"
        report.error("intrinsics-singular", "intrinsics", message, expected="fx > 0 and fy > 0", found=found)
        return None
    return matrix


def _parse_distortion(value: object, report: Report) -> Distortion | None:
    """The lens distortion. None for the model "none", a pinhole camera."""
    models = ("none", *COEFFICIENT_COUNTS)
    model = value.get("model") if isinstance(value, dict) else None
    if not isinstance(value, dict) or model not in models:
        expected, found = " or ".join(models), value if model is None else model
        report.error("distortion-model", "distortion", "has an unknown model", expected=expected, found=found)
        return None
    numbers = value.get("coefficients", [])
    count = len(numbers) if isinstance(numbers, list) else 0
    counts = COEFFICIENT_COUNTS.get(model, (0,))
    if count not in counts:
        expected, message = f"{' or '.join(map(str, counts))} for {model}", "has the wrong number of coefficients"
        report.error("distortion-coefficients", "distortion", message, expected=expected, found=f"{count}")
        return None
    if model == "none":
        return None
    coefficients = parse_numbers(value, "coefficients", (count,), replace(report, prefix="distortion."))
    return None if coefficients is None else Distortion(model, tuple(map(float, coefficients)))
