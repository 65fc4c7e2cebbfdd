"""`bevcli weights`: inspects and converts weights files, and lists the parts of a model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from bevcli.checkpoints import CheckpointSummary
    from bevcli.model.parts import ModelPart

weights_app = typer.Typer(help="Inspect and convert weights files.", no_args_is_help=True)


@weights_app.command()
def inspect(
    file: Annotated[
        Path | None, typer.Argument(help="An official .pth as published, or a .safetensors.", show_default=False)
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="List the parts of this model, such as tiny, base or v2-t2, or a FILE.toml; FILE must fit it.",
            show_default=False,
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print what FILE contains: the models that it fits, tensors, size and metadata.

    With --model, with or without FILE, print the model's parts in the paper's terms (backbone, BEV queries, attentions,
    detection head, …) with the shapes of their weights and the number of their parameters.
    """
    from bevcli.checkpoints import expected_state, read_checkpoint, require_fit
    from bevcli.checkpoints import inspect as inspect_file
    from bevcli.config import load_config
    from bevcli.model.parts import model_parts

    if file is None and model is None:
        raise typer.BadParameter("give FILE, or --model NAME, or both")
    data: dict[str, object] = {}
    texts = []
    if file is not None:
        summary = inspect_file(file)
        data |= _as_data(summary)
        texts.append(_as_text(summary))
    if model is not None:
        config = load_config(model)
        if file is not None:
            require_fit(read_checkpoint(file), config.name, expected_state(config))
        parts = model_parts(config)
        data |= _parts_as_data(config.name, parts)
        texts.append(_parts_as_text(config.name, parts))
    print(json.dumps(data, indent=1) if as_json else "\n\n".join(texts))


@weights_app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="An official .pth as published, or a .safetensors.")],
    destination: Annotated[Path, typer.Argument(help="The .safetensors to write.")],
    force: Annotated[bool, typer.Option("--force", help="Overwrite DESTINATION if it exists.")] = False,
) -> None:
    """Write SOURCE as .safetensors with our key names; it must fit one of our models."""
    from bevcli.checkpoints import convert as convert_file
    from bevcli.errors import OutputError

    if destination.exists() and not force:
        raise OutputError(f"{destination}: already exists; choose another name, or pass --force to overwrite it")
    print(_as_text(convert_file(source, destination)))


def _as_data(summary: CheckpointSummary) -> dict[str, object]:
    return {
        "file": str(summary.path),
        "models": list(summary.models),
        "official_key_names": summary.official,
        "tensors": summary.tensors,
        "parameters": summary.parameters,
        "file_bytes": summary.file_bytes,
        "left_out": summary.left_out,
        "states": dict(summary.facts),
    }


def _as_text(summary: CheckpointSummary) -> str:
    lines = [
        f"{summary.path}: {summary.file_bytes / 1e6:.1f} MB, {summary.tensors} tensors, "
        f"{summary.parameters / 1e6:.1f} M values",
        f"  key names       {'the original BEVFormer' if summary.official else 'bevcli'}",
        f"  fits            {', '.join(summary.models) or 'none of our models'}",
    ]
    if summary.left_out:
        lines.append(f"  left out        {summary.left_out}, which only training uses")
    lines += [f"  {name:<15} {value}" for name, value in summary.facts.items()]
    return "\n".join(lines)


def _parts_as_data(model: str, parts: tuple[ModelPart, ...]) -> dict[str, object]:
    return {
        "model": model,
        "model_parameters": sum(part.parameters for part in parts),
        "parts": [
            {
                "name": part.name,
                "modules": list(part.modules),
                "parameters": part.parameters,
                "shapes": [list(shape) for shape in part.shapes],
            }
            for part in parts
        ],
    }


def _parts_as_text(model: str, parts: tuple[ModelPart, ...]) -> str:
    from bevcli.model.parts import describe_shapes

    width = max(len(part.name) for part in parts)
    lines = [f"{f'model {model}':<{width}}  {'parameters':>12}  shapes of the weights"]
    lines += [
        f"{part.name:<{width}}  {part.parameters:>12,}  {describe_shapes(part.shapes)}".rstrip() for part in parts
    ]
    lines.append(f"{'total':<{width}}  {sum(part.parameters for part in parts):>12,}")
    return "\n".join(lines)
