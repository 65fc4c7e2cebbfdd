"""`bevcli explain`: its figures, and the trace that they are drawn from."""

import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command_line import command
from memory_drive import MemorySequence, make_rig

from bevcli.errors import InputError, OutputError
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner
from bevcli.model.pillar_projection import project_pillars
from bevcli.workshop.explain import figure_files as figures
from bevcli.workshop.explain.drawing import project_bev
from bevcli.workshop.explain.figure_files import check_figures, figures_of, write_figures
from bevcli.workshop.explain.head_figures import reference_points
from bevcli.workshop.explain.overview import FIGURES
from bevcli.workshop.explain.trace import cell_at, trace

SAMPLE = Path(__file__).parents[2] / "samples/street"
CPU = torch.device("cpu")
HISTORY_FIGURES = {"temporal-attention", "recurrence"}
STEPS = [*FIGURES]


def explain(*arguments) -> subprocess.CompletedProcess:
    return command(Path.cwd(), "explain", SAMPLE, *arguments)


def write_all(folder: Path, *options: str) -> None:
    """The figures of the sample's second frame."""
    result = explain("--frame", 1, "--cell", "0.5,12", "--out", folder, *options)
    assert result.returncode == 0, result.stderr
    assert "left out" not in result.stdout


def draw_only(monkeypatch, *steps: str) -> None:
    monkeypatch.setattr(figures, "figures_of", lambda _: {step: FIGURES[step] for step in STEPS if step in steps})


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("figures")
    write_all(folder, "--format", "jpg")  # optimised PNG files take four times as long
    return folder


@pytest.mark.parametrize("step", STEPS)
def test_the_command_writes_a_figure_for_every_step(written, step):
    image = cv2.imread(str(written / f"bevformer-{step}.jpg"))
    height, width, _ = image.shape
    assert width == 1400
    assert 450 <= height <= 1000
    assert (image < 250).any(-1).mean() > 0.05  # not blank


@pytest.mark.slow
def test_two_runs_write_the_same_bytes(tmp_path):
    folders = [tmp_path / name for name in ("one", "other")]
    for folder in folders:
        write_all(folder)
    for step in STEPS:
        one, other = (folder / f"bevformer-{step}.png" for folder in folders)
        assert one.read_bytes() == other.read_bytes(), step


def test_a_figure_of_the_same_frame_has_the_same_bytes(mini_model, tmp_path, monkeypatch):
    draw_only(monkeypatch, "spatial-attention")
    for name in ("one", "other"):
        [_] = write_figures(trace(mini_model, CPU, MemorySequence(1), 0, None), tmp_path / name)
    one, other = (tmp_path / name / "bevformer-spatial-attention.png" for name in ("one", "other"))
    assert one.read_bytes() == other.read_bytes()


def test_figures_are_replaced_only_when_asked(mini_model, tmp_path, monkeypatch):
    draw_only(monkeypatch, "overview", "segmentation")  # the second one is left out
    traced = trace(mini_model, CPU, MemorySequence(1), 0, None)
    check_figures(mini_model.config, tmp_path / "new", force=False)
    for name in ("bevformer-segmentation.png", "bevformer-overview.jpg", "mine.png"):
        (tmp_path / name).write_text("earlier")
        with pytest.raises(OutputError, match="exists already; pass `force=True`"):
            check_figures(mini_model.config, tmp_path, force=False)
    check_figures(mini_model.config, tmp_path, force=True)
    list(write_figures(traced, tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == {"bevformer-overview.png", "mine.png"}


def test_the_command_refuses_a_folder_with_figures(tmp_path):
    out = tmp_path / "runs/street-demo-explained"
    out.mkdir(parents=True)
    (out / "bevformer-overview.png").touch()
    result = command(tmp_path, "explain", SAMPLE.absolute())
    assert result.returncode == 1
    assert "runs/street-demo-explained/bevformer-overview.png: exists already; pass --force" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--frame", 500], "--frame 500: the model takes 20 frames of this sequence, 0 to 19"),
        (["--frame", 0, "--cell", "99,0"], "cell 99,0 is outside the BEV grid (x -32 to 32 m, y -32 to 32 m)"),
        (["--model", "tiny"], "model tiny has no weights"),
    ],
)
def test_mistakes_are_one_line(tmp_path, arguments, expected):
    result = explain(*arguments, "--out", tmp_path / "out")
    assert result.returncode == 1
    assert result.stderr.startswith(f"error: {expected}")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_cell_that_is_no_pair_of_numbers_is_a_usage_error():
    assert explain("--cell", "ahead").returncode == 2


def test_a_model_without_segmentation_leaves_one_figure_out(mini_model, tmp_path, monkeypatch):
    draw_only(monkeypatch, "temporal-attention", "recurrence", "segmentation")
    traced = trace(mini_model, CPU, MemorySequence(3), 2, None)
    left_out = [(step, found) for step, found in write_figures(traced, tmp_path, "jpg") if isinstance(found, str)]
    assert left_out == [("segmentation", "model mini has no segmentation head")]
    assert {path.suffix for path in tmp_path.iterdir()} == {".jpg"}


def test_the_first_frame_of_a_scene_has_no_figures_of_history(mini_model):
    sequence = MemorySequence(4, make_rig({"FRONT": 0.0, "BACK": 180.0}), scenes="aabb")
    traced = trace(mini_model, CPU, sequence, 2, (0.0, -5.0))
    assert traced.prediction.started_anew
    left_out = {step for step, draw in figures_of(mini_model.config).items() if isinstance(draw(traced), str)}
    assert left_out == HISTORY_FIGURES | {"segmentation"}


def test_figures_of_random_weights_are_labelled(mini_model, tmp_path, monkeypatch):
    draw_only(monkeypatch, "can-bus", "pillars")
    traced = trace(mini_model, CPU, MemorySequence(1), 0, None)
    corners = []
    for untrained in (False, True):
        written = list(write_figures(traced, tmp_path, "jpg", untrained=untrained))
        images = [cv2.imread(str(file)) for _, file in written]
        corners.append([(image[:40, -250:] < 250).any() for image in images])
    assert not any(corners[0])
    assert all(corners[1])


def test_a_cell_that_no_camera_sees_still_gives_figures(mini_model, tmp_path):
    traced = trace(mini_model, CPU, MemorySequence(2, make_rig({"FRONT": 0.0})), 1, (0.0, -20.0))
    assert not traced.visible[:, traced.cell_index].any()
    assert (
        len([file for _, file in write_figures(traced, tmp_path, "jpg") if isinstance(file, Path)]) == len(FIGURES) - 1
    )


def test_the_traced_frame_is_predicted_as_in_a_run(mini_model):
    sequence = MemorySequence(4)
    traced = trace(mini_model, CPU, sequence, 3, None)
    *_, (_, prediction, _) = Runner(mini_model, CPU).run(sequence, range(4), Preprocessor(mini_model.config))
    np.testing.assert_array_equal(traced.prediction.boxes.centers, prediction.boxes.centers)
    assert torch.equal(traced.prediction.bev, prediction.bev)
    assert torch.equal(traced.layer_maps[-1], prediction.bev)


def test_last_reference_points_are_the_centres_of_the_box_codes(mini_model):
    traced = trace(mini_model, CPU, MemorySequence(1), 0, None)
    points = reference_points(traced)
    decoder, queries = mini_model.config.decoder.layers, mini_model.config.decoder.queries
    assert points.shape == (decoder + 1, queries, 2)
    centers = traced.prediction.boxes.centers[:, None, :2]
    assert np.linalg.norm(centers - points[-1], axis=-1).min(1).max() < 1e-4


def test_pillars_are_drawn_where_the_network_projects_them(mini_model):
    sequence = MemorySequence(2)
    traced = trace(mini_model, CPU, sequence, 1, None)
    grid, (width, height) = traced.grid, traced.config.image.padded_size
    points = torch.as_tensor(grid.pillars(), dtype=torch.float32).flatten(0, 1)
    inputs = traced.inputs
    projected = project_pillars(inputs.image_from_bev, points, (height, width), inputs.has_image).reference_points[0]
    for place, name in enumerate(traced.prepared.assignment.cameras):
        pixels, visible = project_bev(traced.frame, sequence.rig[name], points.numpy().astype(np.float64))
        network = projected[place].numpy() * (width, height) / traced.prepared.scales[place]
        assert visible.any()
        np.testing.assert_allclose(pixels[visible], network[visible], atol=0.01)


def test_a_place_outside_the_grid_is_an_error(mini_config):
    grid = mini_config.bev_grid  # x -25 to 25 m in 10 columns, y -30 to 30 m in 12 rows
    assert cell_at((-25.0, -30.0), grid) == (0, 0)
    assert cell_at((24.9, 29.9), grid) == (11, 9)
    with pytest.raises(InputError, match="outside the BEV grid"):
        cell_at((25.1, 0.0), grid)
