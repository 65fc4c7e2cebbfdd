"""`bevcli samples`: copy the sample drive and the notebook of the package into the current folder."""

import shutil
from pathlib import Path
from typing import Annotated

from bevcli.options import Option
from bevcli.printing import say
from bevcli.writing import output_errors, write_whole

PANEL = "Start"
NAME, NOTEBOOK = "street", "first_steps.ipynb"


def samples(
    out: Annotated[Path, Option("The folder that gets the sample.", metavar="DIR")] = Path("samples"),
) -> None:
    """Copy the sample drive, a rendered street, to DIR/street, and the notebook first_steps.ipynb.

    The drive is a complete sequence folder. What exists in DIR is left as it is.
    """
    package = Path(__file__).parents[1]
    installed = package / "samples"
    # An editable installation has the samples beside the package.
    source = installed if installed.is_dir() else package.parent / "samples"
    for name, advice in ((NAME, f"run `bevcli run {out / NAME}`"), (NOTEBOOK, "needs pip install 'bevcli[notebook]'")):
        target = out / name
        if target.exists():
            say(f"{target}: exists already")
            continue
        with output_errors(target):
            if (source / name).is_dir():
                shutil.copytree(source / name, target)
            else:
                write_whole(target, (source / name).read_bytes())
        say(f"{target}: copied; {advice}")
