"""The core stands on its own. Who imports whom is in pyproject.toml (`lint-imports`)."""

import subprocess
import sys
from pathlib import Path

import bevcli

ROOT = Path(bevcli.__file__).parent


def test_importing_the_core_loads_no_workshop():
    """Beside its names. `bevcli.calibrate` and `bevcli.render` are texts, imported when they are used."""
    files = [path.relative_to(ROOT).with_suffix("") for path in sorted(ROOT.rglob("*.py"))]
    modules = [".".join(("bevcli", *path.parts)).removesuffix(".__init__") for path in files]
    left_out = (
        "bevcli.workshop",
        "bevcli.__main__",
        "bevcli.model.kernels.triton_",
        "bevcli.recording.av1",
    )  # for optional packages
    core = [module for module in modules if not module.startswith(left_out)]
    code = (
        f"import importlib, sys\nfor name in {core}:\n    importlib.import_module(name)\n"
        "print(*(name for name in sys.modules if name.startswith('bevcli.workshop.')))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not found
