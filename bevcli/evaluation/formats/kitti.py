"""KITTI object labels of one camera."""

from pathlib import Path

from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.export import kitti_calibration, read_kitti_camera, write_kitti
from bevcli.evaluation.options import ExportOptions
from bevcli.sequences.files.boxes_file import BoxesFile


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    calibration = options.calibration or kitti_calibration(source)
    chosen, ego_from_bev = read_kitti_camera(calibration, options.camera)
    labels = write_kitti(boxes, chosen, ego_from_bev, target)
    return f"{len(boxes.frames)} frames, {labels} labels of {chosen.name}"


FORMAT = BoxFormat("kitti", _write)
