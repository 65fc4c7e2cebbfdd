"""A model on a detector as an exported file: features, boxes in images, hybrid queries, in float32 and INT8."""

from pathlib import Path

import pytest
import torch
from small_model import check_file, model_for_engines, small_inputs, step_of_file

from bevcli.model.image_boxes import ImageBoxes
from bevcli.model.nanodet import NanoDetConfig
from bevcli.registry import entries
from bevcli.workshop.engines.export_form import pixels_of
from bevcli.workshop.engines.export_onnx import export_onnx, quantize
from bevcli.workshop.engines.exported import load_exported

pytestmark = pytest.mark.slow  # exports a model of its own
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("openvino")


BESIDE = {"image_detector": NanoDetConfig(), "backbone_scale": (1, 2)}


@pytest.fixture(scope="module", params=["backbone", "beside"])
def model(request):
    """Random weights of a size that gives boxes with scores of all sizes."""
    if request.param == "backbone":
        model = model_for_engines(NanoDetConfig(), hybrid_queries=20)
    else:
        model = model_for_engines(hybrid_queries=20, **BESIDE)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        state = NanoDetConfig().build().state_dict()
    detector = model.image_detector or model.backbone
    detector.load_state_dict({key: 0.3 * x if "gfl_cls" in key else x for key, x in state.items()})
    return model


@pytest.fixture(scope="module")
def file(model, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("nanodet") / "nanodet.onnx"
    export_onnx(model, file, untrained=True)
    return file


@pytest.mark.parametrize("engine", list(entries("bevcli.engines")))
def test_an_engine_equals_the_model(model, file, engine):
    exported = load_exported(file, engine)
    check_file(exported, model)
    inputs = small_inputs()
    inputs.has_image[0, 1] = False
    with torch.inference_mode():
        expected, found = model(inputs).image_boxes, step_of_file(exported, inputs).image_boxes
    assert isinstance(found, ImageBoxes)
    assert expected.scores[0, 0].max() > 0.2
    assert not found.scores[0, 1].any()
    torch.testing.assert_close(found.scores, expected.scores, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found.boxes[0, 0], expected.boxes[0, 0], rtol=0, atol=0.02)
    assert found.labels[0, 0].equal(expected.labels[0, 0])


def test_int8_finds_most_of_the_boxes(model, file, tmp_path):
    images = [pixels_of(small_inputs(seed).images, model.config.image).movedim(2, -1).numpy() for seed in range(4)]
    quantize(file, images, tmp_path / "int8.onnx")
    with torch.inference_mode():
        outputs = (
            model(small_inputs()),
            step_of_file(load_exported(tmp_path / "int8.onnx", "onnxruntime"), small_inputs()),
        )
    bevs, boxes = [x.bev for x in outputs], [x.image_boxes for x in outputs]
    assert 1e-5 < (bevs[0] - bevs[1]).norm() / bevs[0].norm() < 0.2  # of random weights; 0.16 with AVX2 only
    nearest = torch.cdist(boxes[0].boxes[0], boxes[1].boxes[0]).amin(-1)
    assert (nearest < 4).float().mean() > 0.8, nearest
