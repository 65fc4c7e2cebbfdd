"""docs/calibration.md lists the codes of all findings; that each is found is tested beside what finds it."""

import ast
import re
from pathlib import Path

from stated_mistakes import MISTAKES

import bevcli

PACKAGE = Path(bevcli.__file__).parent
DOCUMENT = PACKAGE.parent / "docs" / "calibration.md"
CODE = r"[a-z]+(?:-[a-z]+)+"
DOCUMENTED = set(re.findall(f"`({CODE})`", DOCUMENT.read_text())) - {"project-debug"}
# docs/trust.md has those of faults in images.
FILES = [path for path in PACKAGE.rglob("*.py") if "trust" not in path.parts]
SOURCES = [ast.parse(text) for text in (path.read_text() for path in FILES) if "Finding" in text]
NODES = [node for source in SOURCES for node in ast.walk(source)]


def test_every_finding_is_documented():
    calls = [node for node in NODES if isinstance(node, ast.Call) and ast.unparse(node.func) == "Finding"]
    codes = {call.args[0].value for call in calls if call.args and isinstance(call.args[0], ast.Constant)}
    assert len(codes) > 20
    assert sorted(codes - DOCUMENTED) == []


def test_every_documented_finding_is_in_the_code():
    texts = {node.value for node in NODES if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    of_motion = {code for _, code, *_ in MISTAKES.values()}  # made of their parts
    assert sorted(DOCUMENTED - texts - of_motion) == []


def test_the_images_are_there():
    for image in re.findall(r"\]\((images/[^)]+)\)", DOCUMENT.read_text()):
        assert (DOCUMENT.parent / image).stat().st_size > 10_000
