"""The files of bevcli as syntax trees. The tests of the code share them: one worker runs these tests (conftest.py)."""

import ast
import gc
from functools import cache
from pathlib import Path

import bevcli
from bevcli.parsing.documents import without_garbage_collection

ROOT = Path(bevcli.__file__).parent


@cache
def trees() -> dict[Path, ast.Module]:
    """The syntax tree of each file."""
    with without_garbage_collection():
        found = {path: ast.parse(path.read_text()) for path in sorted(ROOT.rglob("*.py"))}
    gc.freeze()
    return found
