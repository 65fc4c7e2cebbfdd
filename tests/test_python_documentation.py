"""The examples of docs/python.md run, in their order, as they stand."""

import contextlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import bevcli

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "python.md").read_text()
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)


def test_the_examples_run(tmp_path, capsys):
    assert len(EXAMPLES) > 8
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    with contextlib.chdir(tmp_path):
        exec("\n".join(EXAMPLES), {})
    assert "is missing (expected" in capsys.readouterr().out


def test_every_public_name_can_be_imported():
    for name in bevcli.__all__:
        assert getattr(bevcli, name) is not None
    assert set(bevcli.__all__) <= set(dir(bevcli))
    with pytest.raises(AttributeError, match="no_such_name"):
        bevcli.no_such_name  # noqa: B018


def test_importing_bevcli_loads_nothing_heavy():
    heavy = ("torch", "numpy", "cv2", "rerun", "scipy", "numba")
    code = f"import sys, bevcli; print([module for module in {heavy} if module in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
