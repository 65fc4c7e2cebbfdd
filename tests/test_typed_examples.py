"""The examples of the documents pass `mypy --strict` with the types of the package."""

import os
import re
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest

ROOT = Path(__file__).parents[1]
FENCED = re.compile(r"^```python\n(.*?)^```", flags=re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"^ *`([\w./]+\.py)`:\n\n *```python\n(.*?)^ *```", flags=re.MULTILINE | re.DOTALL)
# ROS 2, CARLA and ONNX Runtime have no types.
SETTINGS = """[mypy]
strict = true
follow_imports = silent
[mypy-rclpy.*,nav_msgs.*,sensor_msgs.*,vision_msgs.*,carla,onnxruntime]
ignore_missing_imports = true
[mypy-bevcli_node]
disallow_subclassing_any = false
"""


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text()


@pytest.mark.slow
def test_the_examples_pass_mypy_strict(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    files = {"python_page.py": "\n".join(FENCED.findall(page("python.md")))}
    for document in ("live.md", "extend.md", "service.md"):
        files |= {name: dedent(text) for name, text in NAMED.findall(page(document))}
    assert {"cameras.py", "bevcli_node.py", "carla_client.py", "bevcli_ground/ground.py", "drawing.py"} < files.keys()
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "bevcli_ground/__init__.py").touch()
    (tmp_path / "mypy.ini").write_text(SETTINGS)
    checked = [name for name in files if "/" not in name] + ["bevcli_ground"]
    command = [sys.executable, "-m", "mypy", "--config-file", "mypy.ini", *checked]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
