"""`bevcli weights`: what a file of weights is, and its conversion."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from bevcli.checkpoints import CheckpointSummary

weights_app = typer.Typer(help="Look at files of weights, and convert them.", no_args_is_help=True)


@weights_app.command()
def inspect(
    file: Annotated[Path, typer.Argument(help="An official .pth as published, or a .safetensors.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Say what FILE is: which of our models it fits, tensors, size, and what it states of its training."""
    from bevcli.checkpoints import inspect as inspect_file

    summary = inspect_file(file)
    print(json.dumps(_as_data(summary), indent=1) if as_json else _as_text(summary))


@weights_app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="An official .pth as published, or a .safetensors.")],
    destination: Annotated[Path, typer.Argument(help="The .safetensors to write.")],
    force: Annotated[bool, typer.Option("--force", help="Overwrite DESTINATION where it exists.")] = False,
) -> None:
    """Write SOURCE as .safetensors under our names; it must fit one of our models."""
    from bevcli.checkpoints import convert as convert_file
    from bevcli.errors import OutputError

    if destination.exists() and not force:
        raise OutputError(f"{destination}: exists already; give another name, or --force to overwrite it")
    print(_as_text(convert_file(source, destination)))


def _as_data(summary: CheckpointSummary) -> dict[str, object]:
    return {
        "file": str(summary.path),
        "models": list(summary.models),
        "official_key_names": summary.official,
        "tensors": summary.tensors,
        "parameters": summary.parameters,
        "file_bytes": summary.file_bytes,
        "states": dict(summary.facts),
    }


def _as_text(summary: CheckpointSummary) -> str:
    lines = [
        f"{summary.path}: {summary.file_bytes / 1e6:.1f} MB, {summary.tensors} tensors, "
        f"{summary.parameters / 1e6:.1f} M numbers",
        f"  names of keys   {'the original BEVFormer' if summary.official else 'bevcli'}",
        f"  fits            {', '.join(summary.models) or 'none of our models'}",
    ]
    lines += [f"  {name:<15} {value}" for name, value in summary.facts.items()]
    return "\n".join(lines)
