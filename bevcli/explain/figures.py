"""The figures of a model, and their files."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, get_args

from matplotlib.figure import Figure

from bevcli.errors import OutputError
from bevcli.explain.drawing import ACCENT
from bevcli.explain.options import ImageFormat
from bevcli.explain.step_figure import StepFigure
from bevcli.explain.trace import Trace
from bevcli.model.config import ModelConfig
from bevcli.model.temporal_model import model_class
from bevcli.writing import whole_file


@dataclass(frozen=True)
class FigureFile:
    """One figure.

    Attributes:
        step: its name, `StepFigure.step`.
        path: the file that was written; None where the figure was left out.
        left_out: why it was left out, "" where it was written.
    """

    step: str
    path: Path | None
    left_out: str = ""


def figures_of(config: ModelConfig) -> tuple[StepFigure, ...]:
    """The figures of a model, in the order of its steps."""
    return tuple(figure for listed in model_class(config).figures for figure in resolve_name(listed))


def check_figures(config: ModelConfig, folder: Path, *, force: bool) -> None:
    """Raises OutputError where a folder holds figures of the model already and may not lose them. force: it may."""
    paths = [path for figure in figures_of(config) for path in _paths(config, figure, folder)]
    found = [] if force else [path for path in paths if path.exists()]
    if found:
        raise OutputError(
            f"{found[0]}: exists already; pass `force=True` to replace the figures of the folder, or `out=DIR`"
        )


def write_figures(
    trace: Trace, folder: Path, image_format: ImageFormat = "png", *, untrained: bool = False
) -> Iterator[FigureFile]:
    """Writes `ARCHITECTURE-STEP.png` (or .jpg) per step into a folder, which is created; yields each file when written.

    untrained: whether the weights are random; then every figure is labelled UNTRAINED.
    Figures that the folder holds are replaced, also those of the other format.
    Raises OutputError when the folder or a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: the folder for the figures cannot be made: {error.strerror}") from error
    for step in figures_of(trace.config):
        reason = step.left_out(trace)
        path, *others = sorted(_paths(trace.config, step, folder), key=lambda one: one.suffix != f".{image_format}")
        for earlier in (path, *others) if reason else others:
            earlier.unlink(missing_ok=True)
        if reason:
            yield FigureFile(step.step, None, reason)
            continue
        figure = step.draw(trace)
        if untrained:
            figure.text(0.985, 0.985, "UNTRAINED", color=ACCENT, fontsize=17, fontweight="bold", ha="right", va="top")
        _save(figure, path, image_format)
        yield FigureFile(step.step, path)


def _paths(config: ModelConfig, figure: StepFigure, folder: Path) -> tuple[Path, ...]:
    stem = f"{config.architecture.lower()}-{figure.step}"
    return tuple(folder / f"{stem}.{ending}" for ending in get_args(ImageFormat))


def _save(figure: Figure, path: Path, image_format: ImageFormat) -> None:
    # No software version and no date in the file: the same frame gives the same bytes.
    options: dict[str, Any] = {"metadata": {"Software": None}} if image_format == "png" else {}
    options["pil_kwargs"] = {"optimize": True} if image_format == "png" else {"quality": 86, "optimize": True}
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, format=image_format, **options)
