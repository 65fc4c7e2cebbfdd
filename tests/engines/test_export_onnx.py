"""An exported file computes what the model computes, from standard operators only."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import original_reference as original
import pytest
import torch
from memory_drive import MemoryDrive, make_rig
from small_model import check_file, model_for_engines, small_config, small_inputs, small_model, step_of_file

from bevcli.config import load_config
from bevcli.errors import BevcliError, WeightsError
from bevcli.geometry.object_classes import SHOWN_SCORE
from bevcli.inference import StepOptions
from bevcli.inference.load import Model, load_model
from bevcli.model.bevformer import BEVFormer
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.ego_motion import rotate_history
from bevcli.model.image_tokens import ImageTokensConfig
from bevcli.model.resnet import ResNetConfig
from bevcli.registry import entries, load
from bevcli.sequences.open import open_sequence
from bevcli.workshop.engines.export_form import replace_parts
from bevcli.workshop.engines.export_onnx import export_onnx, read_metadata
from bevcli.workshop.engines.exported import check_exported, for_rig, load_exported

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
ROOT = Path(__file__).parents[2]


def deformable_model() -> BEVFormer:
    """The small model of these tests with deformable convolutions, a third level and two layers in its decoder."""
    config = model_for_engines().config
    tokens = replace(config.image_tokens, level_embeddings=3)
    return small_model(encoder=config.encoder, decoder=replace(config.decoder, layers=2), image_tokens=tokens)


@pytest.fixture(
    scope="module", params=["", *(pytest.param(x, marks=pytest.mark.slow) for x in ("operator", "gridsample"))]
)
def model_and_file(request, small_file, tmp_path_factory) -> tuple[BEVFormer, Path]:
    """A model and its file; with deformable convolutions of either form in the slow tests."""
    if not request.param:
        return model_for_engines(), small_file
    model, file = deformable_model(), tmp_path_factory.mktemp("small") / "small.onnx"
    export_onnx(model, file, deformable_convolution=request.param, decode=True)
    return model, file


@pytest.fixture(scope="module")
def demo_file(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("demo") / "demo.onnx"
    export_onnx(load_model("demo").network, file, decode=True)
    return file


@pytest.mark.slow
def test_a_deformable_convolution_is_an_operator_of_a_file(tmp_path):
    network, x = (
        torch.nn.Sequential(*(ModulatedDeformableConvolution(3, 3, stride) for stride in (1, 2))),
        torch.randn(1, 3, 9, 7),
    )
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    network[1].bias = torch.nn.Parameter(torch.randn(3))  # as after a batch norm is folded into it
    expected = network.eval()(x).detach().numpy()
    replace_parts(network, "operator")
    torch.onnx.export(network, (x,), tmp_path / "x.onnx", dynamo=True, opset_version=19, optimize=False, verbose=False)
    operators = [node.op_type for node in onnx.load(tmp_path / "x.onnx").graph.node]
    assert (operators.count("DeformConv"), "GridSample" in operators) == (2, False)
    session = onnxruntime.InferenceSession(tmp_path / "x.onnx")
    [found] = session.run(None, {session.get_inputs()[0].name: x.numpy()})
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.slow  # with other convolutions; test_engines.py compares the first file
def test_a_file_equals_the_model_with_and_without_history(model_and_file, loaded):
    model, file = model_and_file
    check_file(loaded(file, "onnxruntime"), model)


def test_a_camera_without_an_image_sees_nothing(model_and_file, loaded):
    model, file = model_and_file
    exported = loaded(file, "onnxruntime")
    inputs = small_inputs()
    inputs.has_image[:] = False
    with torch.inference_mode():
        torch.testing.assert_close(step_of_file(exported, inputs).bev, model(inputs).bev, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_file_for_wide_cameras_is_larger_and_embeds_the_rig(tmp_path):
    image = replace(small_config().image, focal_px=115.2, max_pixels=10**6)
    network = small_model(
        image=image,
        backbone=ResNetConfig((1, 1, 1, 1), output_stages=(3, 4), width=8),
        encoder=replace(small_config().encoder, layers=1),
        decoder=replace(small_config().decoder, layers=1),
        image_tokens=ImageTokensConfig(level_embeddings=3, calibration_embedding=True),
    )
    rig = make_rig({"FRONT": 0.0, "BACK": 180.0})
    model = for_rig(Model(network), rig)
    assert (model.config.image.size, network.config.image.size) == ((144, 81), (96, 64))
    export_onnx(model.network, tmp_path / "wide.onnx", contents=model.contents(), cameras=2)
    differences = list(check_exported(tmp_path / "wide.onnx", Model(network), MemoryDrive(2, rig=rig)))
    assert max(row.logits for row in differences) < 1e-3
    assert max(row.bev for row in differences) < 1e-4
    metadata = {entry.key: entry.value for entry in onnx.load(tmp_path / "wide.onnx").metadata_props}
    metadata["config"] = json.dumps(Model(network).contents())
    assert read_metadata(metadata, tmp_path).config.image == small_config().image  # of one size for every rig


def test_decoded_boxes_equal_the_decoder_of_the_library(model_and_file, loaded):
    model, file = model_and_file
    exported = loaded(file, "onnxruntime")
    found: dict[str, np.ndarray] = {}
    hook = exported.engine.register_forward_hook(lambda module, arguments, outputs: found.update(outputs))
    with hook, torch.inference_mode():
        expected = step_of_file(exported, small_inputs()).boxes(model.config)
    boxes, scores, classes = (found[name] for name in ("boxes", "scores", "classes"))
    np.testing.assert_allclose(scores[0], expected.scores, atol=1e-6)
    np.testing.assert_allclose(boxes[0, :, :3], expected.centers, atol=1e-5)
    np.testing.assert_allclose(boxes[0, :, 3:6], expected.sizes_lwh, rtol=1e-5)
    np.testing.assert_allclose(np.exp(1j * boxes[0, :, 6]), np.exp(1j * expected.yaws), atol=1e-5)
    np.testing.assert_allclose(boxes[0, :, 7:], expected.velocities, atol=1e-6)
    assert [model.config.classes[index] for index in classes[0]] == list(expected.classes)


class Rotation(torch.nn.Module):
    """The rotation of a model's history alone."""

    def __init__(self, config):
        super().__init__()
        self.grid, self.center = config.bev_grid, config.ego_motion.history_rotation_center

    def forward(self, history, rotation_deg):
        return rotate_history(history, rotation_deg, self.grid, self.center)


@pytest.mark.slow
def test_the_history_is_rotated_to_the_same_cells(tmp_path):
    """Each cell takes the nearest old one. OpenVINO rounds otherwise where two are equally near (docs/deploy.md)."""
    config, file = load_config("base"), tmp_path / "rotation.onnx"
    rotation, cells = Rotation(config).eval(), config.bev_grid.rows * config.bev_grid.columns
    index = torch.arange(1.0, cells + 1)[None, :, None]  # 0: from outside the map
    names = {"input_names": ["history", "rotation_deg"], "output_names": ["rotated"]}
    torch.onnx.export(rotation, (index, torch.zeros(1)), file, dynamo=True, opset_version=19, verbose=False, **names)
    engines = {name: load("bevcli.engines", name)(file, 1) for name in entries("bevcli.engines")}
    for angle in np.linspace(-9, 9, 21, dtype=np.float32):
        feed = {"history": index.numpy(), "rotation_deg": angle[None]}
        expected = rotation(index, torch.from_numpy(angle[None])).numpy()
        differs = {name: engine(feed)["rotated"] != expected for name, engine in engines.items()}
        assert not differs["onnxruntime"].any()
        assert differs["openvino"].sum() <= 20


def test_a_file_has_standard_operators_and_documents_its_inputs(model_and_file):
    proto = onnx.load(model_and_file[1])
    assert {node.domain for node in proto.graph.node} <= {"", "ai.onnx"}
    assert [(entry.domain, entry.version) for entry in proto.opset_import] == [("", 19)]
    operators = {node.op_type for node in proto.graph.node}
    assert "GridSample" in operators
    documented = {entry.key: entry.value for entry in proto.metadata_props}
    for values, key in ((proto.graph.input, "inputs"), (proto.graph.output, "outputs")):
        assert json.loads(documented[key]) == {value.name: value.doc_string for value in values}
        assert all(value.doc_string.startswith("(") for value in values)


@pytest.mark.slow
def test_demo_equals_our_model_over_a_real_drive(demo_file, shared):
    drive = open_sequence(shared / "data" / "nuscenes-scene-0103", rate_hz=2.0, frames=slice(0, 4))
    agree(demo_file, load_model("demo"), drive)


@pytest.mark.slow
@pytest.mark.timeout(1800)  # base takes 262 s on two cores with nothing beside it
@pytest.mark.parametrize("name", ["tiny", "small", "base"])
def test_published_models_equal_ours_over_a_real_drive(name, shared, tmp_path):
    drive = open_sequence(shared / "data" / "nuscenes-scene-0103", rate_hz=2.0, frames=slice(0, 4))
    model = Model(original.rule_model(name, "both"))
    export_onnx(model.network, tmp_path / "model.onnx")
    # Rounding: in small, the logits of both differ by 2.5e-3 or more from those of the model in float64; in base, they
    # differ by 2.4e-3 from each other.
    agree(tmp_path / "model.onnx", model, drive, logits={"tiny": 1e-3, "small": 3e-3, "base": 3e-3}[name])


def agree(file: Path, model: Model, drive, logits: float = 1e-3) -> None:
    differences = list(check_exported(file, model, drive))
    assert len(differences) == 4
    assert max(row.logits for row in differences) < logits
    assert max(row.box_m for row in differences) < 0.01
    assert max(row.masks for row in differences) < 1e-3


@pytest.mark.slow
def test_the_deployment_pages_program_finds_the_boxes_of_bevcli(demo_file, tmp_path):
    page = (ROOT / "docs" / "deploy.md").read_text()
    program = page.split("```python\n")[1].split("```")[0]
    street = ROOT / "samples" / "street"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program, str(demo_file), str(street)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    runner = load_model("demo", device="cpu").runner(StepOptions())
    runner.config = replace(runner.config, decoder=replace(runner.config.decoder, remember_s=0.0))  # not of the file
    expected = [prediction.boxes for _, prediction, _ in runner.run(open_sequence(street))]
    lines = done.stdout.splitlines()
    assert len(lines) == len(expected)
    for line, boxes in zip(lines, expected, strict=True):
        _, count, best = line.split(maxsplit=2)
        assert int(count) == len(boxes.scored(SHOWN_SCORE))
        np.testing.assert_allclose(json.loads(best)[:3], boxes.centers[0], atol=0.02)


def test_mistakes_are_named(tmp_path):
    with pytest.raises(BevcliError, match="expected 19 or newer"):
        export_onnx(model_for_engines(), tmp_path / "old.onnx", opset=18)
    (tmp_path / "broken.onnx").write_bytes(b"no model")
    for engine in entries("bevcli.engines"):
        with pytest.raises(WeightsError, match="cannot load it"):
            load_exported(tmp_path / "broken.onnx", engine)
        with pytest.raises(WeightsError, match="No such file"):
            load_exported(tmp_path / "missing.onnx", engine)
