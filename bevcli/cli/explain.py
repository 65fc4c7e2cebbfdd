"""`bevcli explain`: figures of what each step of BEVFormer does with one frame."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bevcli.cli.input_options import complete_model, parse_position
from bevcli.cli.run_options import DeviceOption

DEFAULT_FRAME = 10


def explain(
    sequence: Annotated[
        Path, typer.Argument(help="A sequence folder, a folder of videos (one per camera), or a nuScenes root.")
    ],
    frame: Annotated[
        int | None,
        typer.Option(
            min=0,
            help=f"Index of the frame to explain. Default: {DEFAULT_FRAME}, or the last one of a shorter sequence.",
            show_default=False,
        ),
    ] = None,
    cell: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y",
            help="The BEV cell to follow: x, y in metres, bev frame. "
            "Default: the cell under the best-scored box ahead of the vehicle.",
            show_default=False,
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            autocompletion=complete_model,
            help="tiny, small, base, demo, or a FILE.toml. Default: the model that fits --weights, else demo.",
            show_default=False,
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            help="A published .pth or a .safetensors file. Default: the bundled weights, which only demo has.",
            show_default=False,
        ),
    ] = None,
    untrained: Annotated[
        bool, typer.Option("--untrained", help="Use random weights; every figure is labelled UNTRAINED.")
    ] = False,
    device: DeviceOption = "auto",
    scene: Annotated[
        str | None, typer.Option(help="nuScenes: the scene, such as scene-0103.", show_default=False)
    ] = None,
    image_format: Annotated[
        Literal["png", "jpg"], typer.Option("--format", help="File format of the figures.")
    ] = "png",
    out: Annotated[Path, typer.Option(help="Folder for the figures; files of the same name are overwritten.")] = Path(
        "explained"
    ),
) -> None:
    """Draw what each step of BEVFormer does with one frame of SEQUENCE.

    The model runs over all frames of the scene up to --frame, so that the recurrent state is the real one. One figure
    is written per step: image features, BEV queries, can-bus, pillars, spatial cross-attention, temporal
    self-attention, encoder layers, recurrence, object decoder, box code, segmentation, and an overview.
    docs/bevformer.md explains the steps with these figures.
    """
    from bevcli.explain.figures import write_figures
    from bevcli.explain.trace import trace
    from bevcli.pipeline.model_loading import load_model
    from bevcli.sequences.open import open_sequence

    followed = None if cell is None else parse_position(cell, "--cell")
    loaded = load_model(model, weights, device=device, untrained=untrained)
    loaded.require_parts("bevcli explain")
    drive = open_sequence(sequence, scene=scene, rate_hz=loaded.config.rate_hz)
    place = place_of_frame(frame, [stamp.index for stamp in drive.stamps])
    traced = trace(loaded.network, loaded.device, drive, place, followed)
    if loaded.untrained:
        typer.echo("note: the weights are UNTRAINED (random): the figures only show how data flows", err=True)
    x, y = traced.cell_center
    typer.echo(f"frame {traced.frame.stamp.index}, BEV cell at x {x:.2f} m, y {y:.2f} m (bev frame)")
    for figure in write_figures(traced, out, image_format, untrained=loaded.untrained):
        typer.echo(f"{figure.step}: left out, {figure.left_out}" if figure.path is None else str(figure.path))


def place_of_frame(frame: int | None, indices: list[int]) -> int:
    """The place of the frame with this index among the frames that the model takes. Raises InputError."""
    from bevcli.errors import InputError

    if frame is None:
        return min(DEFAULT_FRAME, len(indices) - 1)
    if frame not in indices:
        shown = f"{indices[0]} to {indices[-1]}"
        if len(indices) <= indices[-1] - indices[0]:
            shown += f" in steps of about {(indices[-1] - indices[0]) / (len(indices) - 1):.0f}"
        raise InputError(f"--frame {frame}: the model takes {len(indices)} frames of this sequence, {shown}")
    return indices.index(frame)
