"""Writes frames and predictions into a rerun recording (.rrd).

    record          `record`: a drive with its labels, and boxes of files, without a model
    writer          the class `Recording`: all that is written about a frame, in order; its settings are here
    entities        the entity paths and the colours, shared with the viewer; rows as Arrow arrays
    blueprint       the layout of the views and the order of the cameras
    log_ground      images and lines of the ground: BEV features, maps, probes, lines of models, futures
    log_cameras     one camera's pose, image and overlays; boxes in its image, with labels
    log_boxes       boxes and ground truth in 3D, from above and on the street map; misses, false positives, trails
    log_static      all that is written once: rig, vehicle, range rings, pillars, legend, the page "About"
    meshes          the default car; `bevcli.workshop.meshes` reads files

`bevcli.viewer` reads and shows recordings; nothing here imports it.
"""

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from bevcli.errors import BevcliError, InputError
from bevcli.geometry.object_classes import SHOWN_SCORE
from bevcli.options import option, options

Images = Literal["jpeg", "av1"]
Level = Literal["minimal", "standard", "full"]


def parse_position(text: str) -> tuple[float, float]:
    """A position from a text "X,Y" in metres. Raises ValueError."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise ValueError(f'"{text}" is not a position (expected X,Y in metres, such as 10,-2.5)') from None
    return x, y


def require_av(purpose: str) -> None:
    """Raises BevcliError, which says how to install it, if PyAV is missing. purpose: begins the message."""
    if not has_av():
        raise BevcliError(f"{purpose}: PyAV is not installed: pip install 'bevcli[video]'")


def has_av() -> bool:
    """True if PyAV is installed."""
    return find_spec("av") is not None


@options("Recording")
class RecordingOptions:
    """Content of a recording.

    Raises InputError for an unknown level, kind of BEV image or format of images, and for a mesh file that does not
    exist; BevcliError for "av1" without PyAV.
    """

    level: Level = option(
        default="standard",
        help="minimal: images, boxes, ego pose, curves and events. standard: also the BEV features, the segmentation, "
        "the history map, probes and pillars (at most 25 by 25). full: all pillars of the grid.",
        flag="--record",
    )
    bev: str = option(default="pca", help="How the BEV features are drawn: norm, pca, channel:K or none.")
    score: float = option(
        default=SHOWN_SCORE,
        help="Hide and do not count boxes scored below this; predictions.json keeps all of them.",
        panel="Output",
        minimum=0,
        maximum=1,
    )
    probes: tuple[tuple[float, float], ...] = option(
        default=(),
        help="Show the image points that the BEV cell at X, Y (bev frame, metres) attends to. Repeatable.",
        flag="--probe",
        metavar="X,Y",
        parse=lambda texts: tuple(map(parse_position, texts)),
        repeatable=True,
    )
    vehicle_mesh: Path | None = option(
        reads="path",
        default=None,
        help="Draw the ego vehicle from this mesh (.glb, .ply, .obj, …; metres, origin on the ground under the rear "
        "axle; axes in docs/recording.md). Default: a plain car.",
        metavar="FILE",
    )
    images: Images = option(
        default="jpeg",
        help="jpeg keeps the bytes of the image files, and writes images of a video as JPEG; av1 is one AV1 video "
        "stream for each camera, which is smaller, not lossless, and needs bevcli[video].",
    )

    def __post_init__(self) -> None:
        if not re.fullmatch(r"norm|pca|none|channel:\d+", self.bev):
            raise InputError(f'`bev` (`--bev`): unknown image "{self.bev}" (expected norm, pca, channel:K or none)')
        if self.images == "av1":
            require_av('`images="av1"` (`--images av1`)')
        if self.vehicle_mesh is not None and not self.vehicle_mesh.is_file():
            raise InputError(f"`vehicle_mesh={self.vehicle_mesh}` (`--vehicle-mesh`): there is no such file")

    @property
    def shows_internals(self) -> bool:
        """True if BEV features, segmentation, history, pillars and probes are written."""
        return self.level != "minimal"
