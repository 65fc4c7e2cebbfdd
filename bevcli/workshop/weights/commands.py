"""`bevcli weights`: lists and downloads published weights, inspects and converts files, lists the parts of a model."""

import json
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bevcli.cli.bridge import Json, Part, argument, command, model_option
from bevcli.cli.main import PlainCommand
from bevcli.cli.progress import Progress
from bevcli.errors import OutputError
from bevcli.inference import ModelOptions
from bevcli.options import Option
from bevcli.printing import aligned, counted, print_note, say
from bevcli.registry import is_of_hub
from bevcli.workshop.weights import ModelFileOptions, PackOptions

if TYPE_CHECKING:
    from bevcli.checkpoints import Checkpoint
    from bevcli.published import NamedWeights
    from bevcli.workshop.weights.fetch import FetchedWeights

STOPPED = 130  # exit code of a download that Ctrl-C ends
MB = 1_000_000
PANEL = "Train"
weights_app = typer.Typer(
    help="List, download, inspect and convert weights.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)


@weights_app.command(name="list", cls=PlainCommand)
@command
def list_weights(options: Annotated[ModelOptions, Part(only=("weights_dir",))], as_json: Json = False) -> None:
    """List published weights by name.

    Each has the scores that are published for it (nuScenes validation split, in per cent), its licence, where it lies
    on this machine or is published, and its size where it is stated or the file is here. Connects to no other machine.
    """
    from bevcli.published import all_weights, own_table

    weights = list(all_weights(options.weights_dir).values())
    if as_json:
        say(json.dumps([_named_as_data(item) for item in weights], indent=1))
        return
    say(_named_as_text(weights))
    say(f"\nthe weights of demo and photographs are in the package; your own names go into {own_table()}")


@weights_app.command(cls=PlainCommand)
@command
def fetch(
    name: Annotated[str, argument("A name of `bevcli weights list`, or hf:OWNER/NAME[@REVISION].", reads=None)],
    options: Annotated[ModelOptions, Part(only=("weights_dir",))],
    force: Annotated[bool, Option("Download a file once more that is there.")] = False,
) -> None:
    """Download weights by NAME, for `--model NAME`.

    A cut download goes on where it ended. The file is checked: its hash if that is known, else its size and the keys
    and shapes of the model. A first download's hash is printed and remembered, and every later one must have it.
    """
    from bevcli.published import hub_model, named_weights

    if is_of_hub(name):
        model = hub_model(name, fetch=True)
        say(f"{model.source}\n{model.weights}\nnext: bevcli run SEQUENCE --model {name}")
        return
    fetched = fetch_with_bar(named_weights(name, options.weights_dir), force=force)
    rows = [
        ("weights", f"{fetched.path} ({fetched.known.bytes:,} bytes)"),
        ("sha256", fetched.known.sha256),
        ("checked", f"keys, shapes and size; of the hash: {fetched.checked}"),
        ("next", f"bevcli run SEQUENCE --model {name}"),
    ]
    say("\n".join(f"{title:<8} {text}" for title, text in rows))


@weights_app.command(cls=PlainCommand)
@command
def inspect(
    file: Annotated[Path | None, argument("An official .pth as published, or a .safetensors.")] = None,
    model: Annotated[
        str | None,
        model_option(
            "List the parts of this model, such as tiny, base or v2-t2, or a FILE.toml; FILE must fit it.",
            panel="",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Print what a weights file contains.

    The models that it fits, tensors, size and metadata. With --model, with or without FILE, print the model's parts in
    the paper's terms (backbone, BEV queries, attentions, detection head, …) with the shapes of their weights and the
    number of their parameters.
    """
    from bevcli import checkpoints, config as configs
    from bevcli.workshop.weights.model_file import model_parts, parts_as_text

    if file is None and model is None:
        raise typer.BadParameter("give FILE, or --model NAME, or both")
    data: dict[str, object] = {}
    texts = []
    checkpoint = None if file is None else checkpoints.read_checkpoint(file)
    if checkpoint is not None:
        data |= _as_data(checkpoint)
        texts.append(_as_text(checkpoint))
    if model is not None:
        config = configs.load_config(model)
        if checkpoint is not None:
            checkpoints.require_fit(checkpoint, model, checkpoints.expected_state(config))
        parts = model_parts(config)
        data |= {"model": config.name, "model_parameters": sum(part.parameters for part in parts)}
        data["parts"] = [asdict(part) for part in parts]
        texts.append(parts_as_text(config.name, parts))
    say(json.dumps(data, indent=1) if as_json else "\n\n".join(texts))


@weights_app.command(cls=PlainCommand)
@command
def convert(
    source: Annotated[Path, argument("An official .pth as published, or a .safetensors.")],
    destination: Annotated[Path, argument("The .safetensors to write.", reads=None)],
    force: Annotated[bool, Option("Overwrite the file if it exists.")] = False,
) -> None:
    """Write SOURCE as .safetensors with our key names.

    It must fit one of our models.
    """
    from bevcli.workshop.weights.model_file import convert as convert_file

    if destination.exists() and not force:
        raise OutputError(f"{destination}: already exists; choose another name, or pass --force to overwrite it")
    say(_as_text(convert_file(source, destination)))


@weights_app.command(name="model-file", cls=PlainCommand)
@command
def model_file(
    weights: Annotated[Path, argument("Weights of a known model with other classes: a .pth or a .safetensors.")],
    out: Annotated[Path, argument("The model file to write.", reads=None, metavar="FILE.toml")],
    options: ModelFileOptions,
) -> None:
    """Write the model file of WEIGHTS that fit a known model but for the number or names of its classes.

    `bevcli run SEQUENCE --model FILE.toml --weights WEIGHTS` takes it then.
    """
    from bevcli.workshop.weights.model_file import model_file_for

    config, model = model_file_for(weights, out, options)
    say(f"{out}: {model} with {counted(len(config.classes), 'classes')}: {', '.join(config.classes)}")
    say(f"next: bevcli run SEQUENCE --model {out} --weights {weights}")


@weights_app.command(cls=PlainCommand)
@command
def pack(
    name: Annotated[str, argument("A name as --model takes it, or a FILE.toml.", reads=None, metavar="NAME|FILE")],
    out: Annotated[Path, argument("The folder to write.", reads=None, metavar="DIR")],
    options: PackOptions,
) -> None:
    """Write a model as a folder that the Hugging Face Hub takes: config.json, model.safetensors, README.md.

    README.md is a model card with front matter; read it and add what only you know. Nothing is sent: `hf upload` of
    huggingface_hub does that. `--model hf:OWNER/NAME` then loads the model, equal to the last bit, and
    `--model hf:./DIR` before.
    """
    from bevcli.workshop.weights.hub import pack_model

    files, notes = pack_model(name, out, options)
    for note in notes:
        print_note(note)
    for file in files:
        say(f"{file}: {file.stat().st_size:,} bytes")
    shown = out if out.is_absolute() else f"./{out}"
    say(f"next: bevcli run SEQUENCE --model hf:{shown}, and hf upload OWNER/NAME {out}")


def _named_as_data(weights: "NamedWeights") -> dict[str, object]:
    here = weights.here
    return {
        "name": weights.name,
        "model": weights.model,
        "published": dict(weights.source.published),
        "bytes": weights.size,
        "licence": weights.source.licence,
        "file": None if here is None else str(here),
        "source": weights.source.url or weights.source.source,
        "page": weights.source.page,
    }


def _named_as_text(listed: "list[NamedWeights]") -> str:
    rows = [("name", "model", "published", "size", "licence", "file or source")]
    for weights in listed:
        scores = ", ".join(f"{name} {100 * value:.1f}" for name, value in list(weights.source.published.items())[:2])
        size = "unknown" if weights.size is None else f"{weights.size / 1e6:.1f} MB"
        source = weights.source.url or weights.source.source or f"by hand: {weights.source.page}"
        location = source if weights.here is None else f"here: {weights.here}"
        rows.append((weights.name, weights.model, scores, size, weights.source.licence, location))
    return aligned(rows, left=range(6))


def _as_data(checkpoint: "Checkpoint") -> dict[str, object]:
    return {
        "file": str(checkpoint.path),
        "models": list(checkpoint.models),
        "misfit": "" if checkpoint.models else checkpoint.misfit,
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
        ("fits", ", ".join(checkpoint.models) or checkpoint.misfit.removeprefix("fits ")),
        ("left out", checkpoint.left_out and f"{checkpoint.left_out}, which a run does not need"),
        *checkpoint.facts.items(),
        ("not read", not_read and f"{not_read} (objects that are no weights; nothing was run)"),
    ]
    size, values = checkpoint.path.stat().st_size / 1e6, checkpoint.parameters / 1e6
    lines = [
        f"{checkpoint.path}: {size:.1f} MB, {len(checkpoint.state)} tensors, {values:.1f} M values",
        *(f"  {name:<15} {value}" for name, value in rows if value),
    ]
    return "\n".join(lines)


def fetch_with_bar(weights: "NamedWeights", *, force: bool = False) -> "FetchedWeights":
    """The file of weights, downloaded if it is not there.

    The bar starts when the size is known. Ctrl-C ends the command; what has come is kept.
    """
    from bevcli.workshop.weights.fetch import download_weights, fetch_weights

    bar: Progress | None = None
    with ExitStack() as shown:
        try:
            for done, total in download_weights(weights, force=force):
                if bar is None:
                    note = f"{weights.name}: {weights.source.url}"
                    bar = shown.enter_context(Progress(max(total or 0, done + MB) // MB, "MB", [note]))
                    bar.skip(done // MB)
                bar.reach(done // MB)
        except KeyboardInterrupt:
            if bar is None:
                raise
            say("stopped; the same command goes on from here", err=True)
            raise typer.Exit(STOPPED) from None
    return fetch_weights(weights, force=force)
