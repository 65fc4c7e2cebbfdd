"""Who may import whom: a file imports from its own package and from lower layers only."""

import ast
from pathlib import Path

import bevcli

ROOT = Path(bevcli.__file__).parent
# From the lowest to the highest; names in one set may not import each other.
LAYERS = (
    {"errors", "findings"},
    {"geometry"},
    {"frame"},
    {"model"},
    {"config"},
    {"checkpoints"},
    {"sequences"},
    {"evaluation"},
    {"recording"},
    {"viewer"},
    {"pipeline"},
    {"rig", "synth"},
    {"training", "benchmark", "explain"},
    {"cli"},
    {"__main__"},
)
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}


def imported_parts(path: Path) -> set[str]:
    """The parts of bevcli (first name under the package) that a file imports."""
    modules = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            modules.add(node.module)
        elif isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
    return {module.split(".")[1] for module in modules if module.startswith("bevcli.")}


def test_files_import_from_lower_layers_only():
    wrong = []
    for path in ROOT.rglob("*.py"):
        part = path.relative_to(ROOT).parts[0].removesuffix(".py")
        if part == "__init__":
            continue
        assert part in LEVEL, f"{path}: {part} has no layer"
        wrong += [
            f"{path.relative_to(ROOT)} imports {other}"
            for other in imported_parts(path)
            if other != part and LEVEL[other] >= LEVEL[part]
        ]
    assert not wrong
