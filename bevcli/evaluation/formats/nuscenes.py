"""nuScenes submissions for detection and tracking."""

from pathlib import Path

from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.options import ExportOptions
from bevcli.evaluation.submission import write_submission
from bevcli.sequences.files.boxes_file import BoxesFile


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    write_submission(boxes, target)
    return f"{len(boxes.frames)} samples"


def _write_tracking(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    write_submission(boxes, target, tracking=True)
    return f"{len(boxes.frames)} samples"


DETECTION = BoxFormat("results_nusc.json", _write)
TRACKING = BoxFormat("tracking_nusc.json", _write_tracking)
