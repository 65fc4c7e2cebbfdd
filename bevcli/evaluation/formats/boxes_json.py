"""A boxes file, as predictions.json."""

from pathlib import Path

from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.options import ExportOptions
from bevcli.sequences.files.boxes_file import BoxesFile, write_boxes


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    return f"{write_boxes(boxes, target)} boxes"


FORMAT = BoxFormat("boxes.json", _write)
