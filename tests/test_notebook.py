"""samples/first_steps.ipynb runs from the first cell to the last."""

import shutil
from pathlib import Path

import pytest

SAMPLES = Path(__file__).parents[1] / "samples"


@pytest.mark.slow
def test_the_notebook_runs(tmp_path):
    nbformat = pytest.importorskip("nbformat", reason="needs bevcli[notebook]")
    nbclient = pytest.importorskip("nbclient", reason="needs bevcli[notebook]")
    pytest.importorskip("rerun_notebook", reason="needs bevcli[notebook]")
    shutil.copy(SAMPLES / "first_steps.ipynb", tmp_path)
    (tmp_path / "street").symlink_to(SAMPLES / "street")
    notebook = nbformat.read(tmp_path / "first_steps.ipynb", as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/jpeg" in output.get("data", {}) for output in outputs) == 3
    assert sum("application/vnd.jupyter.widget-view+json" in output.get("data", {}) for output in outputs) >= 1
    assert any("NDS" in output.get("text", "") for output in outputs)
    assert (tmp_path / "first_steps" / "run" / "predictions.json").is_file()
