"""ModelFileOptions: the options of `bevcli weights model-file`."""

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
