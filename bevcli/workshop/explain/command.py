"""`bevcli explain`: figures of what each step of a model does with one frame."""

from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import Part, argument
from bevcli.inference.options import ModelOptions
from bevcli.printing import say
from bevcli.runs.options import RunOptions
from bevcli.sequences.options import SequenceOptions
from bevcli.workshop.explain.options import ExplainOptions

PANEL = "Look"


def explain(
    sequence: Annotated[Path, argument("A sequence folder, a folder of videos (one per camera), or a nuScenes root.")],
    model: Annotated[ModelOptions, Part(only=("model", "weights", "untrained", "device"))],
    options: ExplainOptions,
    run_options: Annotated[RunOptions, Part(only=("command",))],
    source: Annotated[SequenceOptions, Part(only=("scene",))],
) -> None:
    """Draw what each step of the model does with one frame of SEQUENCE.

    The model runs over all frames of the scene up to --frame, so that the recurrent state is the real one. One figure
    is written per step: image features, BEV queries, can-bus, pillars, spatial cross-attention, temporal
    self-attention, encoder layers, recurrence, object decoder, box code, segmentation, and an overview.
    docs/bevformer.md explains the steps with these figures. For VAD two more figures show the objects and the map lines
    that its plan, and the motion of the object nearest to --cell, attended to: see docs/vad.md.
    """
    from bevcli.inference.load import load_model
    from bevcli.sequences.open import open_sequence
    from bevcli.workshop.explain.figure_files import check_figures, write_figures
    from bevcli.workshop.explain.trace import trace

    loaded = load_model(options=model)
    loaded.require_parts("bevcli explain")
    drive = open_sequence(sequence, source, rate_hz=loaded.config.rate_hz)
    out = options.out or Path("runs") / f"{drive.name}-{loaded.name}-explained"
    check_figures(loaded.config, out, force=options.force)
    place = options.place([stamp.index for stamp in drive.stamps])
    traced = trace(loaded.network, loaded.device, drive, place, options.cell, run_options.command)
    if loaded.untrained:
        say("note: the weights are UNTRAINED (random): the figures only show how data flows", err=True)
    x, y = traced.cell_center
    say(f"frame {traced.frame.stamp.index}, BEV cell at x {x:.2f} m, y {y:.2f} m (bev frame)")
    for step, written in write_figures(traced, out, options.image_format, untrained=loaded.untrained):
        say(f"{step}: left out, {written}" if isinstance(written, str) else written)
