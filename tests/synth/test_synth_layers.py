"""The modules of the rendered world import in one direction, from the last of ORDER to the first."""

import ast
from pathlib import Path

from source_code import trees

import bevcli.workshop.synth

ROOT = Path(bevcli.workshop.synth.__file__).parent
ORDER = (
    *("corruptions", "options"),
    *("mesh", "road_users", "catalog", "material"),
    *("city", "density", "looks", "ground", "traffic", "simulation", "scenery"),
    *("rig", "shading_kernels", "photo_kernels", "photo_looks", "renderer"),
    *("drive", "drives", "commands"),
)


def test_modules_import_only_from_those_before_them():
    checked = 0
    for path in (path for path in trees() if path.parent == ROOT and path.stem != "__init__"):
        for node in ast.walk(trees()[path]):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("bevcli.workshop.synth"):
                continue
            inside = (node.module or "").split(".")[3:]
            for other in inside or [alias.name for alias in node.names]:
                assert ORDER.index(other) < ORDER.index(path.stem), f"{path.name} imports {other}"
                checked += 1
    assert checked > 30
