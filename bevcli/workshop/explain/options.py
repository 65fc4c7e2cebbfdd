"""ExplainOptions: the frame and the BEV cell that are explained, and the figures."""

from pathlib import Path
from typing import Literal

from bevcli.errors import InputError
from bevcli.options import option, options
from bevcli.recording.options import parse_position

DEFAULT_FRAME = 10
ImageFormat = Literal["png", "jpg"]


@options()
class ExplainOptions:
    """The frame and the BEV cell that are explained, and the figures."""

    frame: int | None = option(
        default=None,
        help=f"Index of the frame to explain. Default: {DEFAULT_FRAME}, or the last one of a shorter sequence.",
        minimum=0,
    )
    cell: tuple[float, float] | None = option(
        default=None,
        help="The BEV cell to follow: x, y in metres, bev frame. Default: the cell under the best-scored box ahead of "
        "the vehicle.",
        metavar="X,Y",
        parse=parse_position,
    )
    image_format: ImageFormat = option(default="png", help="File format of the figures.", flag="--format")
    out: Path | None = option(default=None, help="Folder for the figures. Default: runs/SEQUENCE-MODEL-explained.")
    force: bool = option(default=False, help="Replace the figures of an earlier call in the folder.")

    def place(self, indices: list[int]) -> int:
        """The place of the frame among the frames that the model takes. indices: of those. Raises InputError."""
        if self.frame is None:
            return min(DEFAULT_FRAME, len(indices) - 1)
        if self.frame not in indices:
            shown = f"{indices[0]} to {indices[-1]}"
            if len(indices) <= indices[-1] - indices[0]:
                shown += f" in steps of about {(indices[-1] - indices[0]) / (len(indices) - 1):.0f}"
            raise InputError(f"`frame={self.frame}`: the model takes {len(indices)} frames of this sequence, {shown}")
        return indices.index(self.frame)
