"""`bevcli validate`: run a model on several drives with ground truth, and score them all together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def validate(
    model: Annotated[str, typer.Argument(help="A known model or a FILE.toml.")],
    weights: Annotated[
        Path | None,
        typer.Option(help="The official .pth, or a .safetensors. Default: the package's own.", show_default=False),
    ] = None,
    data: Annotated[
        list[Path] | None, typer.Option(metavar="DIR", help="A sequence with ground truth. Repeatable.")
    ] = None,
    rendered: Annotated[
        str | None, typer.Option(metavar="SEEDS", help="Rendered drives of these seeds instead: A:B, or A,B,C.")
    ] = None,
    cache: Annotated[Path, typer.Option(metavar="DIR", help="Where rendered drives are kept.")] = Path("runs/drives"),
    temporal: Annotated[bool, typer.Option("--temporal/--no-temporal", help="Use the previous BEV map.")] = True,
    max_range: Annotated[
        float | None,
        typer.Option(metavar="METRES", help="Score nothing farther away. Default: as far as the BEV map reaches."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object in place of the tables.")] = False,
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="auto takes a GPU where there is one.")
    ] = "auto",
) -> None:
    """Run MODEL on drives with ground truth and score them together, as `bevcli run` and `bevcli eval` do for one.

    Rendered drives from seed 1000000 on are never trained on.
    """
    import json

    from bevcli.cli.progress import Progress
    from bevcli.cli.train import open_drives
    from bevcli.evaluation.scores_report import scores_table, scores_to_dict
    from bevcli.model.prepared import prepare_for_inference
    from bevcli.pipeline.model_loading import choose_device, choose_precision, load_model
    from bevcli.pipeline.runner import Runner, StepOptions
    from bevcli.training.validation import validate as validate_model

    loaded = load_model(model, weights, untrained=False)
    drives = open_drives(data or [], rendered, cache, loaded.model.config)
    target = choose_device(device)
    precision = choose_precision(None, target)
    prepared = prepare_for_inference(loaded.model, target, precision)
    runner = Runner(prepared, target, StepOptions(precision, temporal))
    with Progress(sum(len(drives.open(place).stamps) for place in range(len(drives))), "frames") as progress:
        scores = validate_model(runner, drives, max_range, progress.advance)
    if as_json:
        print(json.dumps(scores_to_dict(scores.detection, scores.config, scores.segmentation), indent=1))
    else:
        print(f"drives  {len(drives)}\n\n{scores_table(scores.detection, scores.segmentation)}")
