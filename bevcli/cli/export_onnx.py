"""`bevcli export-onnx`: one step of a model as an ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bevcli.cli.run_options import UntrainedOption, WeightsOption


def export_onnx(
    model: Annotated[
        str, typer.Argument(help="tiny, small, base, demo, v2-t1-base, v2-t1, v2-t2, v2-t8, or a FILE.toml.")
    ],
    weights: WeightsOption = None,
    untrained: UntrainedOption = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Default: MODEL.onnx.", show_default=False)] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file if it exists.")] = False,
    opset: Annotated[int, typer.Option(min=17, help="Version of the ONNX operators.")] = 19,
    deformable_convolution: Annotated[
        Literal["operator", "gridsample"],
        typer.Option(help="operator: DeformConv (opset 19). gridsample: for runtimes without DeformConv."),
    ] = "operator",
    cameras: Annotated[
        int | None, typer.Option(min=1, help="Number of cameras. Default: the model's.", show_default=False)
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A calibration.json: the file is for its number of cameras and, with demo, in the image size for "
            "their fields of view.",
            show_default=False,
        ),
    ] = None,
    cameras_per_cell: Annotated[
        int,
        typer.Option(min=1, help="Number of cameras that may see one BEV cell; more cost time (nuScenes needs 2)."),
    ] = 2,
    decode: Annotated[bool, typer.Option("--decode", help="Add the outputs boxes, scores and classes.")] = False,
    check: Annotated[
        Path | None,
        typer.Option(
            metavar="SEQUENCE",
            help="Run this drive through the file and through our model, and print the largest differences.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write one step of MODEL as an ONNX file of standard operators, without plugins.

    The number of cameras is fixed, the batch is one; calibrations are inputs. What the model remembers is an input and
    an output: the BEV map, or with v2 models image features. The file's metadata documents every input and output.
    docs/deploy.md shows how to run it. Needs pip install 'bevcli\\[onnx]'.
    """
    from bevcli.benchmark.exported import check_exported, difference_lines
    from bevcli.engines.export_onnx import export_onnx as write_onnx
    from bevcli.errors import BevcliError, OutputError
    from bevcli.pipeline.model_loading import load_model
    from bevcli.sequences.files.calibration_file import read_calibration
    from bevcli.sequences.open import open_sequence

    loaded = load_model(model, weights, device="cpu", untrained=untrained)
    loaded.require_parts("bevcli export-onnx")
    if rig is not None:
        if cameras is not None:
            raise BevcliError("--rig states the number of cameras: leave --cameras out")
        own_rig = read_calibration(rig)
        loaded, cameras = loaded.for_rig(own_rig), len(own_rig.cameras)
    target = Path(f"{loaded.name}.onnx") if out is None else out
    if target.exists() and not force:
        raise OutputError(f"{target}: already exists; choose another name, or pass --force to overwrite it")
    drive = None if check is None else open_sequence(check, rate_hz=loaded.config.rate_hz)
    write_onnx(
        loaded.network,
        target,
        opset=opset,
        deformable_convolution=deformable_convolution,
        cameras=cameras,
        cameras_per_cell=cameras_per_cell,
        decode=decode,
        contents=loaded.contents(),
        untrained=loaded.untrained,
        bundled=loaded.bundled,
    )
    typer.echo(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
    if drive is not None:
        differences = list(check_exported(target, loaded, drive))
        typer.echo("\n".join(difference_lines(differences)))
