"""BenchOptions: the options of the benchmark."""

from pathlib import Path
from typing import Literal

from bevcli.inference.options import complete_model
from bevcli.options import option, options
from bevcli.registry import known_models


@options()
class BenchOptions:
    """The model that is measured, and what is written."""

    model: str = option(
        reads="path or name",
        default="tiny",
        help=f"{', '.join(known_models())}, a FILE.toml or a FILE.onnx.",
        metavar="NAME|FILE",
        complete=complete_model,
    )
    frames: int = option(
        default=5,
        help="Number of timed frames, after the warm-up.",
        metavar="N",
        flag="--count",
        minimum=1,
    )
    against: Literal["plain"] | None = option(
        default=None, help="Also run the plain version; compare times and results."
    )
    engines: bool = option(
        default=False,
        help="Time PyTorch and all installed engines side by side, alternating, and compare their boxes. From then on, "
        "`engine=auto` takes the fastest one.",
    )
    profile: Path | None = option(
        default=None, help="Write PyTorch's profile of one frame (open it at chrome://tracing).", metavar="OUT"
    )
    table: Path | None = option(
        default=None,
        help="Measure all models in all precisions, and write the table of docs/speed.md.",
        metavar="OUT",
    )
