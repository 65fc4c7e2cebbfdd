"""StepFigure: the figure of one step of a model. A model lists its own (`TemporalModel.figures`)."""

from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.figure import Figure

from bevcli.explain.trace import Trace


def _always(trace: Trace) -> str:
    return ""


@dataclass(frozen=True)
class StepFigure:
    """The figure of one step.

    Attributes:
        step: its name, the end of the file's name.
        draw: draws it. The title is in the figure.
        left_out: why it cannot be drawn of a trace, "" where it can.
    """

    step: str
    draw: Callable[[Trace], Figure]
    left_out: Callable[[Trace], str] = _always
