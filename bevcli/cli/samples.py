"""`bevcli samples`: copy the sample drive of the package into the current folder."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.bridge import in_group
from bevcli.errors import OutputError

NAME = "street"


@in_group("Start")
def samples(
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder that gets the sample.")] = Path("samples"),
) -> None:
    """Copy the sample drive, a rendered street, to DIR/street. It is a complete sequence folder.

    An existing DIR/street is left as it is.
    """
    target = out / NAME
    if target.exists():
        typer.echo(f"{target}: exists already")
        return
    package = Path(__file__).parents[1]
    installed = package / "samples" / NAME
    try:
        # An editable installation has the sample beside the package.
        shutil.copytree(installed if installed.is_dir() else package.parent / "samples" / NAME, target)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error})") from None
    typer.echo(f"{target}: copied; run `bevcli run {target}`")
