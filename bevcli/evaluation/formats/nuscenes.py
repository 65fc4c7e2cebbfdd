"""nuScenes submissions for detection and tracking."""

from functools import partial
from pathlib import Path

from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.options import ExportOptions
from bevcli.evaluation.submission import write_submission
from bevcli.sequences.files.boxes_file import BoxesFile


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path, *, tracking: bool = False) -> str:
    write_submission(boxes, target, tracking=tracking)
    return f"{len(boxes.frames)} samples"


DETECTION = BoxFormat("results_nusc.json", _write)
TRACKING = BoxFormat("tracking_nusc.json", partial(_write, tracking=True))
