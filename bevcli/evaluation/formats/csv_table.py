"""A CSV table."""

from pathlib import Path

from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.boxes_csv import write_csv
from bevcli.evaluation.options import ExportOptions
from bevcli.sequences.files.boxes_file import BoxesFile


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    return f"{write_csv(boxes, target)} boxes"


FORMAT = BoxFormat("boxes.csv", _write)
