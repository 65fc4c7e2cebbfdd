"""All figures of one traced frame: which there are, why one is left out, and their files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from matplotlib.figure import Figure

from bevcli.errors import OutputError
from bevcli.explain.bev_figures import bev_queries, encoder_layers, recurrence, temporal_attention
from bevcli.explain.camera_figures import image_features, pillars, spatial_attention
from bevcli.explain.drawing import ACCENT
from bevcli.explain.ego_motion_figure import can_bus
from bevcli.explain.head_figures import box_code, decoder, segmentation
from bevcli.explain.overview_figure import overview
from bevcli.explain.trace import Trace

ImageFormat = Literal["png", "jpg"]

# In the order of the model.
FIGURES: dict[str, Callable[[Trace], Figure]] = {
    "overview": overview,
    "image-features": image_features,
    "bev-queries": bev_queries,
    "can-bus": can_bus,
    "pillars": pillars,
    "spatial-attention": spatial_attention,
    "temporal-attention": temporal_attention,
    "encoder-layers": encoder_layers,
    "recurrence": recurrence,
    "decoder": decoder,
    "box-code": box_code,
    "segmentation": segmentation,
}


@dataclass(frozen=True)
class FigureFile:
    """One figure.

    Attributes:
        step: its name, a key of FIGURES.
        path: the file that was written; None where the figure was left out.
        left_out: why it was left out, "" where it was written.
    """

    step: str
    path: Path | None
    left_out: str = ""


def write_figures(
    trace: Trace, folder: Path, image_format: ImageFormat = "png", *, untrained: bool = False
) -> Iterator[FigureFile]:
    """Writes `bevformer-STEP.png` (or .jpg) per step into a folder, which is created; yields each file when written.

    untrained: whether the weights are random; then every figure is labelled UNTRAINED.
    Files of the same name are overwritten. Raises OutputError when the folder or a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: the folder for the figures cannot be made: {error.strerror}") from error
    for step, draw in FIGURES.items():
        reason = reason_to_leave_out(step, trace)
        if reason:
            yield FigureFile(step, None, reason)
            continue
        path = folder / f"bevformer-{step}.{image_format}"
        figure = draw(trace)
        if untrained:
            figure.text(0.985, 0.985, "UNTRAINED", color=ACCENT, fontsize=17, fontweight="bold", ha="right", va="top")
        _save(figure, path, image_format)
        yield FigureFile(step, path)


def reason_to_leave_out(step: str, trace: Trace) -> str:
    """Why a figure cannot be drawn of this trace; "" where it can."""
    prediction = trace.prediction
    if step == "temporal-attention" and prediction.started_anew:
        return f"the frame has no history ({prediction.started_anew})"
    if step == "recurrence" and len(trace.recent) < 2:
        return "there is no earlier frame"
    if step == "segmentation" and trace.outputs.segmentation is None:
        return f"model {trace.config.name} has no segmentation head"
    return ""


def _save(figure: Figure, path: Path, image_format: ImageFormat) -> None:
    # No software version and no date in the file: the same frame gives the same bytes.
    options: dict[str, Any] = {"metadata": {"Software": None}} if image_format == "png" else {}
    options["pil_kwargs"] = {"optimize": True} if image_format == "png" else {"quality": 86, "optimize": True}
    try:
        figure.savefig(path, format=image_format, **options)
    except OSError as error:
        raise OutputError(f"{path}: the figure cannot be written: {error.strerror}") from error
