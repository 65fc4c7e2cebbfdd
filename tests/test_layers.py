"""Who may import whom: a file imports from its own package and from lower layers only, and no imports form a cycle."""

import ast
from pathlib import Path

import bevcli

ROOT = Path(bevcli.__file__).parent
# From the lowest to the highest; names in one set may not import each other.
LAYERS = (
    {"duration", "errors", "findings"},
    {"parsing", "jit", "waiting"},
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
    {"rig", "synth", "engines", "batch"},
    {"training", "benchmark", "explain"},
    {"robustness"},
    {"cli"},
    {"__main__"},
)
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
FILES = {
    ".".join(("bevcli", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in ROOT.rglob("*.py")
}


def imports(path: Path) -> set[str]:
    """The modules of bevcli that a file imports, anywhere: in functions and for type checking too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names} & FILES.keys()
            found |= submodules or {node.module}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {module for module in found if module in FILES}


def test_files_import_from_lower_layers_only():
    wrong = []
    for path in FILES.values():
        part = path.relative_to(ROOT).parts[0].removesuffix(".py")
        if part == "__init__":  # the public names, which are imported when they are used
            continue
        assert part in LEVEL, f"{path}: {part} has no layer"
        others = {module.split(".")[1] for module in imports(path) if "." in module}
        wrong += [
            f"{path.relative_to(ROOT)} imports {other}"
            for other in others
            if other != part and LEVEL[other] >= LEVEL[part]
        ]
    assert not wrong


def test_no_imports_form_a_cycle():
    left = {module: imports(path) - {"bevcli", module} for module, path in FILES.items() if module != "bevcli"}
    while free := {module for module, needed in left.items() if not needed & left.keys()}:
        left = {module: needed for module, needed in left.items() if module not in free}
    assert not left, f"these modules import each other: {sorted(left)}"
