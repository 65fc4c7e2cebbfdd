"""Who may import whom: a file imports from its own package and from lower layers only, and no imports form a cycle.

Tests have short names.
"""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import get_args

from source_code import ROOT, trees

import bevcli
from bevcli.registered import Group

# The core from the lowest to the highest; names in one set may not import each other.
LAYERS = (
    {"_version", "findings", "printing"},
    {"errors", "registered"},
    {"options", "registry"},
    {"parsing", "jit", "writing"},
    {"published"},
    {"geometry"},
    {"frame"},
    {"model"},
    {"config"},
    {"checkpoints"},
    {"weights"},
    {"sequences"},
    {"evaluation"},
    {"recording"},
    {"viewer"},
    {"inference"},
    {"rig"},
    {"runs"},
    {"cli"},
    {"__main__"},
)
# The wings of the workshop, and which others each may import; all may import the core.
WINGS: dict[str, set[str]] = {
    "batch": {"trust"},
    "benchmark": {"engines"},
    "calibration": {"correspondence", "odometry"},
    "checks": {"benchmark"},
    "correspondence": set(),
    "engines": set(),
    "formats": set(),
    "hub": set(),
    "odometry": {"correspondence", "formats"},
    "robustness": {"calibration", "synth"},
    "synth": {"formats"},
    "scores": set(),
    "training": {"synth", "trust"},
    "trust": {"correspondence", "odometry", "robustness", "scores", "synth"},
    "uniad": set(),
    "vad": {"formats", "training"},
}
WORKSHOP = "bevcli.workshop."
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
FILES = {
    ".".join(("bevcli", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in ROOT.rglob("*.py")
}


def imports(path: Path) -> set[str]:
    """The modules of bevcli that a file imports, anywhere: in functions and for type checking too."""
    found = set()
    for node in ast.walk(trees()[path]):
        if isinstance(node, ast.ImportFrom) and node.module:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names} & FILES.keys()
            found |= submodules or {node.module}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {module for module in found if module in FILES}


def test_files_of_the_core_import_from_lower_layers_only():
    wrong = []
    for path in FILES.values():
        part = path.relative_to(ROOT).parts[0].removesuffix(".py")
        if part in ("__init__", "workshop"):  # __init__ has the public names, which are imported when they are used
            continue
        assert part in LEVEL, f"{path}: {part} has no layer"
        others = {module.split(".")[1] for module in imports(path) if "." in module} - {"workshop"}
        wrong += [
            f"{path.relative_to(ROOT)} imports {other}"
            for other in others
            if other != part and LEVEL[other] >= LEVEL[part]
        ]
    assert not wrong


def test_the_core_imports_nothing_of_the_workshop():
    core = {module: path for module, path in FILES.items() if not module.startswith(WORKSHOP) and module != "bevcli"}
    found = {module for module, path in core.items() if any(f"{each}.".startswith(WORKSHOP) for each in imports(path))}
    assert not found


def test_a_wing_imports_the_core_and_what_it_states():
    wrong = []
    for path in (path for path in FILES.values() if path.is_relative_to(ROOT / "workshop")):
        wing = path.relative_to(ROOT).parts[1].removesuffix(".py")
        others = {module.split(".")[2] for module in imports(path) if module.startswith(WORKSHOP)}
        wrong += [f"{path.relative_to(ROOT)} imports {other}" for other in others - {wing} - WINGS.get(wing, set())]
    assert not wrong
    assert {path.name for path in (ROOT / "workshop").iterdir() if path.is_dir()} - {"__pycache__"} == WINGS.keys()


def test_no_imports_form_a_cycle():
    left = {module: imports(path) - {module} for module, path in FILES.items() if module != "bevcli"}
    while free := {module for module, needed in left.items() if not needed & left.keys()}:
        left = {module: needed for module, needed in left.items() if module not in free}
    assert not left, f"these modules import each other: {sorted(left)}"


def test_names_of_tests_have_at_most_60_characters() -> None:
    files = sorted((ROOT.parent / "tests").rglob("test_*.py"))
    names = [name for path in files for name in re.findall(r"^ *def (test_\w+)", path.read_text(), flags=re.MULTILINE)]
    assert len(names) > 1000
    assert [name for name in names if len(name) > 60] == []


def functions(path: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(trees()[path]) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def test_no_function_has_more_than_10_parameters() -> None:
    wrong = []
    for module, path in FILES.items():
        for function in functions(path):
            taken = function.args
            names = [each.arg for each in (*taken.posonlyargs, *taken.args, *taken.kwonlyargs)]
            compiled = any("jit" in ast.unparse(each) for each in function.decorator_list)  # kernels, which take arrays
            if len(set(names) - {"self", "cls"}) > 10 and not compiled and "kernels" not in module:
                wrong.append(f"{module}.{function.name}: {len(names)}")
    assert not wrong


NAMED = re.compile(r"(?<![\w.-])bevcli(?:\.[A-Za-z_]\w*)+")


def exists(name: str) -> bool:
    """True for a module, a public name, an attribute that a module defines, or a group of the registry."""
    module, _, attribute = name.rpartition(".")
    return (
        name in FILES
        or name in get_args(Group)
        or name in {f"bevcli.{each}" for each in bevcli.__all__}
        or attribute in defined(module)
    )


@cache
def defined(module: str) -> set[str]:
    """The functions, classes and constants of a module; nothing of one that does not exist."""
    nodes = ast.walk(trees()[FILES[module]]) if module in FILES else ()
    return {getattr(node, "name", None) or getattr(node, "id", "") for node in nodes}


def test_modules_and_names_that_texts_state_exist() -> None:
    """Such as those in docstrings, and in the metadata of exported files."""
    assert exists("bevcli.workshop.engines.engine.Engine")
    assert not exists("bevcli.inference.defog")
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in FILES.values()
        for name in NAMED.findall(path.read_text())
        if not exists(name)
    ]
    assert not wrong


# A command or a program, which the text names in backticks.
COMMAND = re.compile(r"`[a-z-]+ [^`]*`")
FLAG = re.compile(r"(?<![\w-])--[a-z]")


def library_texts(path: Path) -> list[str]:
    """The texts of a file, but for arguments of programs and spellings of options."""
    tree = trees()[path]
    spellings = {id(each.value) for each in ast.walk(tree) if isinstance(each, ast.keyword) and each.arg == "flag"}
    formatted = [node for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)]
    parts = {id(part) for text in formatted for part in text.values}
    plain = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    texts = ["".join(getattr(part, "value", "") if isinstance(part, ast.Constant) else "X" for part in text.values)
             for text in formatted]  # fmt: skip
    texts += [node.value for node in plain if id(node) not in spellings | parts]
    return [text for text in texts if not re.fullmatch(r"--[\w-]+", text)]


def test_the_library_names_arguments_and_no_flags() -> None:
    wrong = []
    for module, path in FILES.items():
        if (
            module.startswith("bevcli.cli.")
            or re.fullmatch(r"bevcli\.workshop\.\w+\.commands", module)
            or module == "bevcli.options"
        ):  # these define flags
            continue
        texts = [text for text in library_texts(path) if ":root" not in text]  # CSS
        wrong += [f"{module}: {text:.100}" for text in texts if FLAG.search(COMMAND.sub("", text))]
    assert not wrong


def test_only_a_download_uses_libcurl_and_http():
    """And only `fetch_weights` downloads, which is called where `fetch` was given, or by a command that is for it."""
    users: dict[str, set[str]] = {}
    for path, tree in trees().items():
        for node in ast.walk(tree):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{each.name}" for each in node.names)]
            for name in names:
                users.setdefault(name, set()).add(path.relative_to(ROOT).as_posix())
    assert users["pycurl"] == {"weights/fetch.py"}
    assert users["bevcli.weights.fetch.fetch_weights"] == {"inference/load.py", "cli/progress.py"}
    assert users["urllib.request"] == {"viewer/web.py"}  # which asks the viewer on this machine
    assert not {"requests", "httpx", "aiohttp", "http.client", "urllib3"} & users.keys()


def test_importing_the_core_loads_no_workshop():
    """Beside its names. `bevcli.calibrate` and `bevcli.render` are texts, imported when they are used."""
    left_out = ("bevcli.workshop", "bevcli.__main__", "bevcli.model.kernels.triton_")  # Triton may be missing
    core = [module for module in FILES if not module.startswith(left_out)]
    code = (
        f"import importlib, sys\nfor name in {core}:\n    importlib.import_module(name)\n"
        "print(*(name for name in sys.modules if name.startswith('bevcli.workshop.')))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert set(found) <= {"bevcli.workshop.registered"}
