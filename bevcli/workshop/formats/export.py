"""`export`: write the boxes of a run, a boxes file or a recording in another format."""

from pathlib import Path
from typing import Any

from bevcli.errors import InputError
from bevcli.options import gather
from bevcli.printing import counted
from bevcli.sequences.files.boxes_file import BoxesFile, above_score, read_boxes, write_boxes
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import read_recording
from bevcli.workshop.formats import ExportOptions
from bevcli.workshop.formats.kitti import export_kitti
from bevcli.workshop.formats.submission import write_submission
from bevcli.writing import check_output

# Format -> the name of the file or folder that is written next to the boxes by default.
TARGETS = {
    "csv": "boxes.csv", "json": "boxes.json", "kitti": "kitti", "nuscenes": "results_nusc.json",
    "nuscenes-tracking": "tracking_nusc.json",
}  # fmt: skip


def export(predictions: str | Path, options: ExportOptions | None = None, **changes: Any) -> tuple[Path, str]:
    """Write boxes as a table, a boxes file, KITTI labels or a nuScenes submission, as `bevcli export` does.

        bevcli.export("runs/first", form="csv")

    Args:
        predictions: predictions.json, ground_truth.json, the folder of a run, or a recording, whose shown boxes are
            written.
        options: see `ExportOptions`; or as keywords.
        changes: the options as keywords: `form` ("csv", "json", "kitti", "nuscenes", "nuscenes-tracking"), `out`,
            `score`, `calibration` and `camera`.

    Returns the file or folder, and what was written, such as "20 boxes".

    Raises InputError for predictions that cannot be read or that the format cannot hold, and OutputError.
    """
    target, what, _ = export_boxes(Path(predictions), gather(ExportOptions, options, changes))
    return target, what


def export_boxes(predictions: Path, options: ExportOptions) -> tuple[Path, str, str]:
    """Write boxes, see `export`: the file, what was written, and a note where a recording is incomplete, or ""."""
    if options.form not in TARGETS:
        raise InputError(f"`form={options.form}` (`--format`): unknown format (expected {', '.join(TARGETS)})")
    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    target = options.out or file.parent / TARGETS[options.form]
    check_output(target, file)
    boxes, note = _boxes_of(file)
    return target, _write(above_score(boxes, options.score), target, options, file), note


def _boxes_of(file: Path) -> tuple[BoxesFile, str]:
    """The boxes of a boxes file or of a recording, and a note."""
    if file.suffix.lower() != ".rrd":
        return read_boxes(file), ""
    with open_recording(file) as whole:
        note = "" if whole == file else f"{file} is incomplete (its run was stopped or is still going)"
        return read_recording(whole), note


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    """Write boxes of a file, and say what, such as "20 frames, 3 tracks"."""
    if options.form == "kitti":
        return export_kitti(boxes, target, options, source)
    if options.form in ("csv", "json"):
        return counted((write_csv if options.form == "csv" else write_boxes)(boxes, target), "boxes")
    return counted(write_submission(boxes, target, tracking=options.form == "nuscenes-tracking"), "samples")
