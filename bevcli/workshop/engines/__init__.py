"""Other programs that compute the model: export to ONNX, ONNX Runtime and OpenVINO in the place of PyTorch, INT8."""

from pathlib import Path
from typing import Literal

from bevcli.errors import OutputError
from bevcli.options import option, options


@options()
class FileOptions:
    """The file that is written."""

    out: Path | None = option(default=None, help="Default: MODEL.onnx, or FILE-int8.onnx.")
    force: bool = option(default=False, help="Overwrite the file if it exists.")

    def target(self, default: Path) -> Path:
        """The file to write. Raises OutputError where it exists and `force` is false."""
        target = default if self.out is None else self.out
        if target.exists() and not self.force:
            raise OutputError(
                f"{target}: already exists; choose another name, or pass `force=True` (`--force`) to overwrite it"
            )
        return target


@options()
class OnnxOptions:
    """The options of `export_onnx`, and a check of the written file."""

    opset: int = option(default=19, help="Version of the ONNX operators.", minimum=17)
    deformable_convolution: Literal["operator", "gridsample"] = option(
        default="operator",
        help="operator: DeformConv (opset 19). gridsample: for runtimes without DeformConv. Models without deformable "
        "convolutions are the same in both.",
    )
    cameras: int | None = option(default=None, help="Number of cameras. Default: the model's.", minimum=1)
    rig: Path | None = option(
        reads="path",
        default=None,
        help="A calibration.json: the file is for its number of cameras and, with demo, in the image size for their "
        "fields of view.",
        metavar="FILE",
    )
    cameras_per_cell: int = option(
        default=2,
        help="Number of cameras that may see one BEV cell (nuScenes needs 2): the file fails on a rig where more do, "
        "and its time for spatial cross-attention is proportional to it.",
        minimum=1,
    )
    decode: bool = option(default=False, help="Add the outputs boxes, scores and classes.")
    check: Path | None = option(
        reads="path",
        default=None,
        help="Run this drive through the file and through our model, and print the largest differences.",
        metavar="SEQUENCE",
    )
