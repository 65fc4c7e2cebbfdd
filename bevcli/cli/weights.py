"""`bevcli weights`: inspects and converts weights files, and lists the parts of a model."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bevcli.cli.bridge import INPUT, INPUT_OR_NAME, Json, Part, command
from bevcli.cli.help_text import PlainCommand
from bevcli.engines.options import FileOptions
from bevcli.inference.options import complete_model
from bevcli.printing import say

if TYPE_CHECKING:
    from bevcli.checkpoints import Checkpoint
    from bevcli.model.parts import ModelPart

PANEL = "Train"
weights_app = typer.Typer(
    help="Inspect and convert weights files.", no_args_is_help=True, add_completion=False, rich_markup_mode=None
)


@weights_app.command(cls=PlainCommand)
@command
def inspect(
    file: Annotated[
        Path | None, typer.Argument(help="An official .pth as published, or a .safetensors.", show_default=False), INPUT
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="List the parts of this model, such as tiny, base or v2-t2, or a FILE.toml; FILE must fit it.",
            show_default=False,
            autocompletion=complete_model,
            metavar="NAME|FILE",
        ),
        INPUT_OR_NAME,
    ] = None,
    as_json: Json = False,
) -> None:
    """Print what a weights file contains.

    The models that it fits, tensors, size and metadata. With --model, with or without FILE, print the model's parts in
    the paper's terms (backbone, BEV queries, attentions, detection head, …) with the shapes of their weights and the
    number of their parameters.
    """
    from bevcli.checkpoints import expected_state, read_checkpoint, require_fit
    from bevcli.config import load_config
    from bevcli.model.parts import model_parts

    if file is None and model is None:
        raise typer.BadParameter("give FILE, or --model NAME, or both")
    data: dict[str, object] = {}
    texts = []
    checkpoint = None if file is None else read_checkpoint(file)
    if checkpoint is not None:
        data |= _as_data(checkpoint)
        texts.append(_as_text(checkpoint))
    if model is not None:
        config = load_config(model)
        if checkpoint is not None:
            require_fit(checkpoint, config.name, expected_state(config))
        parts = model_parts(config)
        data |= {"model": config.name, "model_parameters": sum(part.parameters for part in parts)}
        data["parts"] = [asdict(part) for part in parts]
        texts.append(_parts_as_text(config.name, parts))
    say(json.dumps(data, indent=1) if as_json else "\n\n".join(texts))


@weights_app.command(cls=PlainCommand)
@command
def convert(
    source: Annotated[Path, typer.Argument(help="An official .pth as published, or a .safetensors."), INPUT],
    destination: Annotated[Path, typer.Argument(help="The .safetensors to write.")],
    options: Annotated[FileOptions, Part(only=("force",))],
) -> None:
    """Write SOURCE as .safetensors with our key names.

    It must fit one of our models.
    """
    from bevcli.checkpoints import convert as convert_file

    say(_as_text(convert_file(source, options.target(destination))))


def _as_data(checkpoint: "Checkpoint") -> dict[str, object]:
    return {
        "file": str(checkpoint.path),
        "models": list(checkpoint.models),
        "official_key_names": checkpoint.official,
        "tensors": len(checkpoint.state),
        "parameters": checkpoint.parameters,
        "file_bytes": checkpoint.path.stat().st_size,
        "left_out": checkpoint.left_out,
        "states": dict(checkpoint.facts),
        "not_read": list(checkpoint.not_read),
    }


def _as_text(checkpoint: "Checkpoint") -> str:
    not_read = ", ".join(checkpoint.not_read)
    rows = [
        ("key names", "the original BEVFormer" if checkpoint.official else "bevcli"),
        ("fits", ", ".join(checkpoint.models) or "none of our models"),
        ("left out", checkpoint.left_out and f"{checkpoint.left_out}, which only training uses"),
        *checkpoint.facts.items(),
        ("not read", not_read and f"{not_read} (objects that are no weights; nothing was run)"),
    ]
    size, values = checkpoint.path.stat().st_size / 1e6, checkpoint.parameters / 1e6
    lines = [
        f"{checkpoint.path}: {size:.1f} MB, {len(checkpoint.state)} tensors, {values:.1f} M values",
        *(f"  {name:<15} {value}" for name, value in rows if value),
    ]
    return "\n".join(lines)


def _parts_as_text(model: str, parts: tuple["ModelPart", ...]) -> str:
    from bevcli.model.parts import describe_shapes

    width = max(len(part.name) for part in parts)
    lines = [f"{f'model {model}':<{width}}  {'parameters':>12}  shapes of the weights"]
    lines += [
        f"{part.name:<{width}}  {part.parameters:>12,}  {describe_shapes(part.shapes)}".rstrip() for part in parts
    ]
    lines.append(f"{'total':<{width}}  {sum(part.parameters for part in parts):>12,}")
    return "\n".join(lines)
