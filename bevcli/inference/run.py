"""`run`: a model over a drive, frame by frame."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame, Prediction
from bevcli.inference import StepOptions
from bevcli.inference.load import Model
from bevcli.options import refuse, spread


def run(model: Model, sequence: Drive, **options: Any) -> Iterator[tuple[Frame, Prediction]]:
    """Runs a model over a sequence, frame by frame; the BEV map of a frame is the history of the next.

        for frame, prediction in bevcli.run(model, drive):
            print(frame.stamp.index, len(prediction.boxes))

    Frames are read and prepared in the background. Nothing is kept of a frame after it was yielded.

    Args:
        model: of `load_model`.
        sequence: of `open_sequence`.
        options: those of `StepOptions`: `temporal`, `track`, `attention`, `probes`, `cameras`, `command`.

    Raises:
        InputError: a frame cannot be read, a probe lies outside the BEV grid, a camera or a command is unknown, or the
            attention of an exported file is asked for.
    """
    for argument, value, maker in (("model", model, "load_model"), ("sequence", sequence, "open_sequence")):
        if isinstance(value, str | Path):
            raise InputError(f"`{argument}={value}`: is a text or path: pass what `bevcli.{maker}` returns for it")
    step_options, rest = spread(options, StepOptions)
    refuse(rest, "run", StepOptions)
    shows = step_options.attention or step_options.probes
    runner = model.in_engine(sequence.rig, sequence, parts="attention and probes" if shows else "").runner(step_options)
    return ((frame, prediction) for frame, prediction, _ in runner.run(sequence))
