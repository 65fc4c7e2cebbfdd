"""The modules of the rendered world import in one direction, from the last of ORDER to the first."""

import ast
from pathlib import Path

from source_code import trees

import bevcli.workshop.synth

ROOT = Path(bevcli.workshop.synth.__file__).parent
ORDER = (
    *("corruptions", "options"),
    *("mesh", "vehicles", "people", "street_objects", "catalog"),
    *("city", "looks", "ground", "traffic", "roadside", "scenery", "simulation"),
    *("rig", "shading_kernels", "renderer"),
    *("drive", "drives", "commands"),
)


def test_modules_import_only_from_those_before_them():
    checked = 0
    for path in (path for path in trees() if path.parent == ROOT and path.stem != "__init__"):
        for node in ast.walk(trees()[path]):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bevcli.workshop.synth."):
                other = node.module.split(".")[3]
                assert ORDER.index(other) < ORDER.index(path.stem), f"{path.name} imports {node.module}"
                checked += 1
    assert checked > 30
