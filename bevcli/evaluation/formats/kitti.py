"""KITTI object labels of one camera."""

from pathlib import Path

from bevcli.errors import InputError
from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.export import read_kitti_camera, write_kitti
from bevcli.evaluation.options import ExportOptions
from bevcli.sequences.files.boxes_file import BoxesFile


def _write(boxes: BoxesFile, target: Path, options: ExportOptions) -> str:
    if options.calibration is None:
        raise InputError("`form=kitti` needs `calibration`: KITTI labels are in a camera frame")
    chosen, ego_from_bev = read_kitti_camera(options.calibration, options.camera)
    labels = write_kitti(boxes, chosen, ego_from_bev, target)
    return f"{len(boxes.frames)} frames, {labels} labels of {chosen.name}"


FORMAT = BoxFormat("kitti", _write)
