"""`record`: writes a drive with its labels, and boxes of one or two models against them, into a recording."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.printing import counted
from bevcli.recording import RecordingOptions
from bevcli.recording.log_static import RecordedBoxes
from bevcli.recording.writer import Recording
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.sequences.open import count_labels, open_sequence
from bevcli.workshop.scores.detection import ranges_m
from bevcli.workshop.scores.inputs import RELIABLE, ScoredInput, boxes_of_drive, open_predictions
from bevcli.writing import whole_file

MOST = 2  # models: each has a colour
FAR_M = 150.0  # boxes that are all farther away are of another drive, or in another frame of reference
GivenBoxes = str | Path | Sequence[Boxes3D | None]


def record(
    drive: Drive | str | Path,
    boxes: GivenBoxes | Mapping[str, GivenBoxes] | None = None,
    path: str | Path = "recording.rrd",
    *,
    score: float | None = None,
    class_map: Mapping[str, str] | None = None,
) -> Path:
    """Write a drive and its labels, without a model, into a recording, which `bevcli viz` and `bevcli.show` open.

        bevcli.record(drive)  # labels, in the colours of their classes
        bevcli.record(drive, "results_nusc.json")  # boxes of one model; labels pale; misses and false positives red
        bevcli.record(drive, {"old": "old.json", "new": "new.json"}, "compared.rrd")  # two models, each in a colour

    Args:
        drive: of `open_sequence`, or its path.
        boxes: of one model, or name -> boxes of one or two: a file that `bevcli.evaluate` reads, the folder of a run,
            or boxes in the world frame for each frame of the drive, None where it has none. None for labels alone.
        path: the .rrd file to write; an existing one is replaced.
        score: boxes scored below this are left out; None for 0.25.
        class_map: class names in the files -> the classes of the labels.

    Returns:
        The path. `record_steps` gives the loop, with its frames and notes.

    Raises:
        InputError: a file is missing or wrong, or has no frame of the drive.
        OutputError: the recording cannot be written.
    """
    drive = open_sequence(drive, class_map=class_map or {}) if isinstance(drive, str | Path) else drive
    for _ in record_steps(drive, boxes, path, score, class_map):
        pass
    return Path(path)


def record_steps(
    drive: Drive,
    boxes: GivenBoxes | Mapping[str, GivenBoxes] | None,
    path: str | Path,
    score: float | None = None,
    class_map: Mapping[str, str] | None = None,
) -> Iterator[Frame | str]:
    """As `record`, step by step: each frame after it was written, and lines for the user.

    The lines say which frames were matched, and how, or that there are no labels.
    """
    sources = dict(boxes) if isinstance(boxes, Mapping) else {} if boxes is None else {_name_of(boxes): boxes}
    if len(sources) > MOST:
        raise InputError(
            f"`boxes` (`--boxes`): found those of {len(sources)} models (expected at most {MOST}): leave some out"
        )
    inputs = {name: _open(source, name, drive, class_map) for name, source in sources.items()}
    of_frames = []
    for name, source in inputs.items():
        by_frame, notes = _by_frame(drive, name, source)
        of_frames.append(by_frame)
        yield from notes
    options = RecordingOptions(level="minimal") if score is None else RecordingOptions(level="minimal", score=score)
    labelled = 0
    with whole_file(Path(path)) as file, Recording(file, drive, _recorded(drive, inputs), options) as recording:
        for index in range(len(drive.stamps)):
            frame = drive.load(index)
            recording.log(frame, [by_frame[index] for by_frame in of_frames])
            labelled += frame.ground_truth is not None
            yield frame
    if labelled < len(drive.stamps):
        yield f"{drive.name}: no labels in {len(drive.stamps) - labelled} of {counted(len(drive.stamps), 'frames')}"


def names_of(paths: Iterable[Path]) -> dict[str, Path]:
    """Short names of files of boxes: that of the file, or the folder of a run, with the folder above where they agree.

    Raises InputError where a file is given twice.
    """
    files = list(paths)
    short = [path.resolve().parent if path.name == "predictions.json" else path for path in files]
    names = [_name_of(path) for path in short]
    if len(set(names)) < len(names):
        names = [f"{path.resolve().parent.name}/{name}" for path, name in zip(short, names, strict=True)]
    if len(set(names)) < len(names):
        raise InputError(f"`boxes` (`--boxes`): {files[0]} and {files[-1]} have the same name: rename one")
    return dict(zip(names, files, strict=True))


def _name_of(boxes: GivenBoxes) -> str:
    """The name of a file or folder without its ending."""
    if not isinstance(boxes, str | Path):
        return "boxes"
    path = Path(boxes).resolve()
    return path.name if path.is_dir() else path.stem


def _open(boxes: GivenBoxes, name: str, drive: Drive, class_map: Mapping[str, str] | None) -> ScoredInput:
    """The boxes of one model. Raises InputError."""
    if isinstance(boxes, str | Path):
        return open_predictions(Path(boxes), class_map)
    of_one_frame = isinstance(boxes, Boxes3D)
    wrong: list[object] = [of_frame for of_frame in boxes if of_frame is not None and not isinstance(of_frame, Boxes3D)]
    if of_one_frame or wrong:
        found = "those of one frame" if of_one_frame else f"a {type(wrong[0]).__name__}"
        raise InputError(
            f"`boxes` (`--boxes`): {name}: found {found} (expected a file, or a list with the Boxes3D of each frame in "
            "the world frame)"
        )
    if len(boxes) != len(drive.stamps):
        raise InputError(
            f"`boxes` (`--boxes`): {name}: found {len(boxes)} (expected {len(drive.stamps)}, one for each frame)"
        )
    pairs = zip(drive.stamps, boxes, strict=True)
    frames = tuple(FrameBoxes(stamp, None, of_frame) for stamp, of_frame in pairs if of_frame is not None)
    return ScoredInput(BoxesFile("world" if drive.has_ego_motion else "ego", frames), Path(name))


def _by_frame(drive: Drive, name: str, source: ScoredInput) -> tuple[list[Boxes3D | None], list[str]]:
    """The boxes of one model for each frame of the drive, and lines for the user. Raises InputError with its name."""
    try:
        of_frames, pairs = boxes_of_drive(source.boxes, drive)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    matched = len(pairs.predictions)
    rest = len(source.boxes.frames) - matched
    more = f"; not in the drive: {counted(rest, 'further frames')}" if rest else ""
    key = pairs.matched_by if pairs.matched_by in RELIABLE else f"{pairs.matched_by}, as scenes or times differ"
    notes = [f"{name}: has boxes of {matched} of {counted(len(of_frames), 'frames')}, matched by {key}{more}"]
    sides = zip(pairs.predictions, pairs.ego_xy, strict=True)
    away = np.concatenate([np.linalg.norm(frame.boxes.centers[:, :2] - ego, axis=1) for frame, ego in sides])
    if len(away) and away.min() > FAR_M:
        notes.append(f"warning: {name}: the nearest box is {away.min():.0f} m from the vehicle: is it of this drive?")
    return of_frames, notes


def _recorded(drive: Drive, inputs: Mapping[str, ScoredInput]) -> RecordedBoxes:
    """The classes of the boxes, and where they are scored."""
    classes: dict[str, ObjectClass] = dict(NUSCENES_CLASSES)
    first_map = drive.ground_truth_frame(0).ground_truth_map
    of_map = () if first_map is None else tuple(first_map.classes)
    if not inputs:  # labels alone have no class that is not theirs
        classes |= {name: ObjectClass(name) for name in sorted(count_labels(drive).keys() - classes.keys())}
        return RecordedBoxes(classes=classes, map_classes=of_map)
    first = next(iter(inputs.values()))
    classes = dict(first.boxes.classes or classes)
    limit = first.range_m or float("inf")
    ranges = {name: min(range_m, limit) for name, range_m in ranges_m(classes.values()).items()}
    untrained = any(source.boxes.extras.get("untrained") is True for source in inputs.values())
    return RecordedBoxes(tuple(inputs), classes, ranges, untrained, of_map)
