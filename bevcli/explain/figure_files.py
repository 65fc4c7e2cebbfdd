"""StepFigure: the figure of one step of a model; and the files of all figures of a model, which lists its own.

See `TemporalModel.figures`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from matplotlib.figure import Figure

from bevcli.errors import OutputError
from bevcli.explain.drawing import ACCENT
from bevcli.explain.options import ImageFormat
from bevcli.explain.trace import Trace
from bevcli.model.config import ModelConfig
from bevcli.model.temporal_model import model_class
from bevcli.writing import whole_file

# Of matplotlib. No software version and no date in the file: the same frame gives the same bytes.
SAVING: dict[ImageFormat, dict[str, Any]] = {
    "png": {"metadata": {"Software": None}, "pil_kwargs": {"optimize": True}},
    "jpg": {"pil_kwargs": {"quality": 86, "optimize": True}},
}


@dataclass(frozen=True)
class StepFigure:
    """The figure of one step.

    Attributes:
        step: its name, the end of the file's name.
        draw: draws it, with its title, or says why it cannot be drawn of a trace.
    """

    step: str
    draw: Callable[[Trace], Figure | str]


def figures_of(config: ModelConfig) -> tuple[StepFigure, ...]:
    """The figures of a model, in the order of its steps."""
    return tuple(figure for listed in model_class(config).figures for figure in resolve_name(listed))


def check_figures(config: ModelConfig, folder: Path, *, force: bool) -> None:
    """Raises OutputError where a folder holds figures of the model already and may not lose them. force: it may."""
    paths = [path for figure in figures_of(config) for path in _paths(config, figure, folder).values()]
    found = [] if force else [path for path in paths if path.exists()]
    if found:
        raise OutputError(
            f"{found[0]}: exists already; pass `force=True` to replace the figures of the folder, or `out=DIR`"
        )


def write_figures(
    trace: Trace, folder: Path, image_format: ImageFormat = "png", *, untrained: bool = False
) -> Iterator[tuple[str, Path | str]]:
    """Writes `ARCHITECTURE-STEP.png` (or .jpg) per step into a folder, which is created.

    Yields the name of each step with the file, when it is written, or with the reason why its figure is left out.
    untrained: whether the weights are random; then every figure is labelled UNTRAINED.
    Figures that the folder holds are replaced, also those of the other format.
    Raises OutputError when the folder or a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: the folder for the figures cannot be made: {error.strerror}") from error
    for step in figures_of(trace.config):
        figure = step.draw(trace)
        paths = _paths(trace.config, step, folder)
        for ending, earlier in paths.items():
            if isinstance(figure, str) or ending != image_format:
                earlier.unlink(missing_ok=True)
        if isinstance(figure, str):
            yield step.step, figure
            continue
        if untrained:
            figure.text(0.985, 0.985, "UNTRAINED", color=ACCENT, fontsize=17, fontweight="bold", ha="right", va="top")
        with whole_file(paths[image_format]) as unfinished:
            figure.savefig(unfinished, format=image_format, **SAVING[image_format])
        yield step.step, paths[image_format]


def _paths(config: ModelConfig, figure: StepFigure, folder: Path) -> dict[ImageFormat, Path]:
    stem = f"{config.architecture.lower()}-{figure.step}"
    return {ending: folder / f"{stem}.{ending}" for ending in SAVING}
