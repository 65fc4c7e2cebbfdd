"""The parts of the rendered world import in one direction, from the last of LAYERS to the first."""

import ast
from pathlib import Path

from source_code import trees

import bevcli.workshop.synth

ROOT = Path(bevcli.workshop.synth.__file__).parent
LAYERS = (
    *("corruptions", "workers", "assets", "world", "render"),
    *("options", "rig", "drive", "export", "drives", "splits", "command", "demo_command"),
)


def test_parts_import_only_from_lower_parts():
    checked = 0
    for path in (path for path in trees() if path.is_relative_to(ROOT)):
        part = path.relative_to(ROOT).parts[0].removesuffix(".py")
        if part == "__init__":
            continue
        for node in ast.walk(trees()[path]):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bevcli.workshop.synth."):
                other = node.module.split(".")[3]
                assert LAYERS.index(other) <= LAYERS.index(part), f"{path.relative_to(ROOT)} imports {node.module}"
                checked += 1
    assert checked > 50
