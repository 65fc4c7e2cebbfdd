"""Formats of other programs: drives, labels and boxes, and `convert`. Here are the options of labels and of writers."""

from pathlib import Path
from typing import Literal

from bevcli.options import option, options
from bevcli.registry import entries

UnlistedFrames = Literal["empty", "unlabelled"]


@options("Input")
class LabelOptions:
    """Ground truth from a file of labels."""

    labels: Path | None = option(
        reads="path",
        default=None,
        help="Ground truth in place of that of INPUT: a CSV table with the columns of `bevcli export --format csv`, "
        "KITTI labels or tracklets, or CVAT's cuboids.",
        metavar="FILE",
    )
    unlisted_frames: UnlistedFrames | None = option(
        default=None,
        help="Frames without a row in a table of labels are empty, or not labelled. Default: empty, unless no two "
        "successive frames have rows; then only every n-th frame is labelled.",
    )
    labels_camera: str | None = option(
        default=None,
        help="The camera in whose frame KITTI labels are. Default: the one that looks most directly ahead.",
        metavar="NAME",
    )


@options()
class WriteOptions:
    """The options of a drive that is written."""

    form: str = option(
        default="native",
        help="native: a sequence folder. nuscenes: a nuScenes root. mcap: one file for Foxglove and ROS 2, with boxes. "
        "Or the format of an installed package.",
        flag="--format",
        metavar="NAME",
        complete=lambda incomplete: list(entries("bevcli.drive_writers")),
    )
    force: bool = option(default=False, help="Overwrite an existing drive in OUT.")
    boxes: Path | None = option(
        reads="path", default=None, help="mcap: also write the boxes of this run (a folder or predictions.json)."
    )
    score: float = option(
        default=0.25, help="mcap: leave out boxes of the run scored below this.", minimum=0, maximum=1
    )
