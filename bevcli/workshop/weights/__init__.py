"""`bevcli weights`: lists, downloads, inspects, converts and shares weights, and names the classes of other ones.

Only `fetch` and `hub` connect to another machine, and only where they are called. Here are the options of `model-file`
and `pack`.
"""

from pathlib import Path

from bevcli.options import option, options


def parse_names(text: str) -> tuple[str, ...]:
    """The names in a text with commas between them."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


@options("Model")
class ModelFileOptions:
    """The classes of a model file."""

    classes: tuple[str, ...] = option(
        default=(),
        help="Names of the classes in the order of the training. Default: those that the weights state.",
        metavar="NAME,NAME,…",
        parse=parse_names,
    )
    force: bool = option(default=False, help="Overwrite the file if it exists.")


@options("Card")
class PackOptions:
    """The weights of a folder for the Hugging Face Hub, and what its model card states."""

    weights: Path | None = option(
        reads="path or name",
        default=None,
        help="A .pth or a .safetensors that fits MODEL. Default: those in the package (demo, photographs), or "
        "downloaded ones.",
        panel="Model",
    )
    licence: str = option(
        default="", help="Licence of the weights, such as Apache-2.0 or other. Default: that of `bevcli weights list`."
    )
    datasets: tuple[str, ...] = option(
        default=(),
        help="Data that the weights were trained on. Default: nuscenes for published weights.",
        metavar="NAME,NAME,…",
        parse=parse_names,
    )
    scores: Path | None = option(
        reads="path",
        default=None,
        help="Scores of the model on data that it was not trained on: the output of `bevcli validate --json`. Default: "
        "the published ones.",
        metavar="FILE.json",
    )
    scored_on: str = option(
        default="", help="The data of the scores, such as 'validation drives of 2026'.", metavar="TEXT"
    )
    force: bool = option(default=False, help="Overwrite the files if they exist.")
