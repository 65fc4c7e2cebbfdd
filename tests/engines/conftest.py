"""A small exported model and its copy in INT8, which the tests of engines share."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from small_model import model_for_engines, small_inputs

from bevcli.config import as_table
from bevcli.inference.tracking import TrackerConfig
from bevcli.workshop.engines.export_form import pixels_of
from bevcli.workshop.engines.export_onnx import export_onnx, quantize
from bevcli.workshop.engines.exported import ExportedModel, load_exported


@pytest.fixture(scope="session")
def small_file(tmp_path_factory) -> Path:
    pytest.importorskip("onnxscript")  # here, as the import takes a second of each worker
    model, file = model_for_engines(), tmp_path_factory.mktemp("small") / "small.onnx"
    contents = as_table(model.config, TrackerConfig(birth_score=0.5))
    export_onnx(model, file, contents=contents, decode=True, untrained=True)
    return file


@pytest.fixture(scope="session")
def int8_file(small_file) -> Path:
    file, config = small_file.with_name("small-int8.onnx"), model_for_engines().config
    images = [pixels_of(small_inputs(seed).images, config.image).movedim(2, -1).numpy() for seed in range(4)]
    quantize(small_file, images, file)
    return file


@pytest.fixture(scope="session")
def loaded() -> Callable[[Path, str], ExportedModel]:
    """`load_exported`, which keeps what it has loaded."""
    return cache(load_exported)
