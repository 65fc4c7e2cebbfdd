"""The files of all figures of a model, which lists its own: see `TemporalModel.figures`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bevcli.errors import OutputError
from bevcli.model.config import ModelConfig
from bevcli.model.temporal_model import model_class
from bevcli.registry import for_model
from bevcli.workshop.explain.drawing import ACCENT, Draw
from bevcli.workshop.explain.options import ImageFormat
from bevcli.workshop.explain.trace import Trace
from bevcli.writing import whole_file

# Of matplotlib. No software version and no date in the file: the same frame gives the same bytes.
SAVING: dict[ImageFormat, dict[str, Any]] = {
    "png": {"metadata": {"Software": None}, "pil_kwargs": {"optimize": True}},
    "jpg": {"pil_kwargs": {"quality": 86, "optimize": True}},
}


def figures_of(config: ModelConfig) -> dict[str, Draw]:
    """The figures of a model by the name of the step, the end of the file's name, in the order of the steps."""
    return dict(next(iter(for_model("figures", model_class(config))), {}))


def check_figures(config: ModelConfig, folder: Path, *, force: bool) -> None:
    """Raises OutputError where a folder holds figures of the model already and may not lose them. force: it may."""
    paths = [path for step in figures_of(config) for path in _paths(config, step, folder).values()]
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
    for step, draw in figures_of(trace.config).items():
        figure = draw(trace)
        paths = _paths(trace.config, step, folder)
        for ending, earlier in paths.items():
            if isinstance(figure, str) or ending != image_format:
                earlier.unlink(missing_ok=True)
        if isinstance(figure, str):
            yield step, figure
            continue
        if untrained:
            figure.text(0.985, 0.985, "UNTRAINED", color=ACCENT, fontsize=17, fontweight="bold", ha="right", va="top")
        with whole_file(paths[image_format]) as unfinished:
            figure.savefig(unfinished, format=image_format, **SAVING[image_format])
        yield step, paths[image_format]


def _paths(config: ModelConfig, step: str, folder: Path) -> dict[ImageFormat, Path]:
    stem = f"{config.architecture.lower()}-{step}"
    return {ending: folder / f"{stem}.{ending}" for ending in SAVING}
