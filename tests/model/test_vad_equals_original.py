"""VAD-tiny equals the released code, from images to the planned path (float32, CPU); and so does its exported form.

golden_vad.npz in tests/data holds a part of the original's numbers for the first two frames; all numbers of four frames
are in the folder golden/ of BEVCLI_SHARED. The goldens have the same rule of weights. golden_keys_vad.json has the keys
and shapes of the official weights that BEVFormer tiny does not have with the same shape, and those of tiny that VAD
does not have.
"""

import json
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import original_reference as original
import pytest
import torch
from memory_drive import MemoryDrive
from original_reference import DATA, official_shapes
from stated_rule import rule_tensor

from bevcli.checkpoints import expected_state, from_official
from bevcli.config import load_config
from bevcli.inference import run
from bevcli.inference.load import Model
from bevcli.model.prepare import prepare_for_inference
from bevcli.workshop.engines.export_onnx import export_onnx
from bevcli.workshop.engines.exported import FrameDifference, check_exported, difference_lines, load_exported
from bevcli.workshop.vad.vad import VAD, VADConfig, VADOutputs, decode_futures, decode_lines, line_positions

KEPT = np.load(original.DATA / "golden_vad.npz")
SCENE_STARTS = (0, 3)
Arrays = Mapping[str, np.ndarray]


@cache
def model() -> VAD:
    return rule_vad()


@cache
def prepared_model() -> VAD:
    return prepare_for_inference(model(), torch.device("cpu"))


@cache
def outputs_of(frame: int, prepared: bool = False) -> VADOutputs:
    """The outputs for one of the four frames."""
    network = prepared_model() if prepared else model()
    history = None if frame in SCENE_STARTS else outputs_of(frame - 1, prepared).bev
    with torch.inference_mode():
        return network(original.inputs(frame, model().config), history)


def close(found: torch.Tensor | np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(np.asarray(found), expected.reshape(found.shape), atol=tolerance, rtol=0)


def of_frame(arrays: Arrays, frame: int) -> dict[str, np.ndarray]:
    return {key.partition("_")[2]: arrays[key] for key in arrays if key.startswith(f"f{frame}_")}


def check_results(outputs: VADOutputs, expected: Arrays) -> None:
    """Boxes with futures, lines and plan. Neighbours in score are 1e-5 apart: match by class and place."""
    config = model().config
    boxes = decode_futures(outputs, config)
    close(boxes.scores, expected["scores_3d"], 1e-4)
    middle = expected["boxes_3d"].astype(float)
    middle[:, 2] += middle[:, 5] / 2
    rows = original.match_boxes(boxes, middle, expected["labels_3d"], config.classes)
    boxes = boxes[rows]
    assert np.abs(np.array(rows) - np.arange(len(rows))).max() <= 2
    close(boxes.centers, middle[:, :3], 1e-2)
    close(boxes.sizes_lwh[:, [1, 0, 2]], middle[:, 3:6], 1e-2)
    close(np.exp(1j * boxes.yaws), np.exp(-1j * (middle[:, 6] + np.pi / 2)), 1e-3)
    close(boxes.velocities, middle[:, 7:], 1e-2)
    futures = boxes.futures[..., 1:] - boxes.centers[:, None, None, :2]
    close(futures, expected["trajs_3d"].cumsum(2), 1e-2)
    check_lines(outputs, expected)
    *_, plan = model().decode(outputs)
    assert plan.commands == ("right", "left", "straight")
    close(plan.paths, expected["ego_traj"], 1e-2)
    np.testing.assert_allclose(plan.times_s, [0.5, 1, 1.5, 2, 2.5, 3])


def check_lines(outputs: VADOutputs, expected: Arrays) -> None:
    lines = decode_lines(outputs, model().config)
    close(lines.scores, expected["map_scores_3d"], 1e-4)
    points, names = np.stack(lines.points), np.array(model().config.line_decoder.classes)
    distance = np.abs(points - expected["map_pts_3d"][:, None]).max((2, 3))
    distance[names[expected["map_labels_3d"]][:, None] != lines.classes] = np.inf
    row = distance.argmin(1)
    assert len(set(row.tolist())) == len(row)
    assert np.abs(row - np.arange(len(row))).max() <= 2
    close(points[row], expected["map_pts_3d"], 1e-2)


def check_stages(outputs: VADOutputs, expected: Arrays) -> None:
    """What enters the results, stage by stage."""
    close(outputs.class_logits[:, 0], expected["all_cls_scores"], 1e-3)
    codes = torch.from_numpy(expected["all_bbox_preds"])
    close(outputs.box_codes[:, 0, :, :8], codes[..., :8].numpy(), 1e-2)
    lines, motion = outputs.lines, outputs.motion
    close(lines.class_logits[:, 0], expected["map_all_cls_scores"], 1e-3)
    close(lines.points[-1, 0] * torch.tensor([30.0, 60.0]), expected["map_all_pts_preds_last"] * (30, 60), 1e-2)
    close(motion.offsets[0], expected["traj_preds"], 1e-2)
    close(motion.mode_logits[0], expected["traj_cls"], 1e-3)
    close(outputs.plan[0], expected["ego_fut_preds"], 1e-2)
    with torch.inference_mode():
        check_selection(outputs, expected)


def check_selection(outputs: VADOutputs, expected: Arrays) -> None:
    """The lines that objects attend to; the released code selects them, ours masks them."""
    network, lines = model(), outputs.lines
    tokens = network.map_tokens(lines)
    nearest = line_positions(lines.points[-1])
    keep = expected["map_keep"]
    assert np.array_equal(tokens.scores[0] > 0.5, keep)
    index = (lines.points[-1, 0] - nearest[0][:, None]).abs().sum(-1).argmin(-1)
    assert np.array_equal(index, expected["map_near_index"])
    close(nearest[0], expected["map_near_pos"], 1e-4)
    relative, masked = network.motion_head.lines_in_reach(network.positions(outputs.box_codes[-1]), tokens)
    columns = [*np.flatnonzero(keep), len(keep)]
    assert np.array_equal(masked[0][:, columns], expected["agent_map_masked"])
    assert masked[0][:, :-1][:, ~keep].all()
    close(relative[0, ::10][:, columns], expected["agent_map_pos_sub"], 1e-4)
    close(tokens.features[0, :, ::2], expected["lane_query_sub"], 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("frame", [0, 1])
def test_vad_equals_the_original(frame: int) -> None:
    outputs, expected = outputs_of(frame), of_frame(KEPT, frame)
    close(outputs.bev[0, ::111], expected["bev_embed_sub"], 1e-3)
    check_stages(outputs, expected)
    check_results(outputs, expected)


def test_the_released_files_keys_are_those_of_the_model() -> None:
    released = {key: torch.empty(shape, device="meta") for key, shape in vad_shapes().items()}
    assert len(released) == 746
    found, left_out = from_official(released)
    assert left_out == "pts_bbox_head.map_code_weights"
    expected = expected_state(load_config("vad-tiny"))
    assert {key: x.shape for key, x in found.items()} == {key: x.shape for key, x in expected.items()}


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("frame", [0, 1, 2, 3])
def test_prepared_vad_equals_all_results(shared: Path, frame: int) -> None:
    expected = of_frame(np.load(shared / "golden/golden_vad_tiny.npz"), frame)
    outputs = outputs_of(frame, prepared=True)
    close(outputs.bev[0, ::37], expected["bev_embed_sub"], 1e-3)
    check_stages(outputs, expected)
    check_results(outputs, expected)


STEM_GAIN = 1 / 57
HEAD = r"pts_bbox_head\."
ROOT = 512**0.5
# Metres a step, x and y, of the commands right, left, straight.
PATHS = [0.4, 2.5] * 6 + [-0.4, 2.5] * 6 + [0.0, 3.0] * 6
# Pattern of a key, then what its tensor by the common rule is multiplied with, and what is added to that. They make
# lines and modes differ, and put some objects and lines above the thresholds.
_CHANGES: tuple[tuple[str, float | list[float], float | list[float]], ...] = (
    (rf"{HEAD}cls_branches\.\d+\.6\.bias", 1.0, -1.7),
    (rf"{HEAD}reg_branches\.\d+\.4\.weight", [0.3, 0.3, 1, 1, 0.3, 1, 1, 1, 1, 1], 0.0),
    (rf"{HEAD}map_instance_embedding\.weight", ROOT, 0.0),
    (rf"{HEAD}map_pts_embedding\.weight", 0.3 * ROOT, 0.0),
    (rf"{HEAD}transformer\.map_reference_points\.weight", 2.0, 0.0),
    (rf"{HEAD}transformer\.map_decoder\..*(attn\.out_proj|ffns\.0\.layers\.1)\.weight", 0.3, 0.0),
    (rf"{HEAD}transformer\.map_decoder\..*output_proj\.weight", 0.4, 0.0),
    (rf"{HEAD}map_reg_branches\.\d+\.4\.weight", 0.5, 0.0),
    (rf"{HEAD}map_cls_branches\.\d+\.6\.bias", 1.0, -1.8),
    (rf"{HEAD}(motion_mode|ego)_query\.weight", 16.0, 0.0),
    (rf"{HEAD}(motion|motion_map|ego_agent|ego_map)_decoder\..*\.in_proj_weight", [2.0] * 512 + [1.0] * 256, 0.0),
    (rf"{HEAD}ego_fut_decoder\.4\.bias", 1.0, PATHS),
)


def vad_shapes() -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights."""
    file = json.loads((DATA / "golden_keys_vad.json").read_text())
    of_tiny = {key: shape for key, shape in official_shapes("tiny").items() if key not in file["not_of_tiny"]}
    return of_tiny | {key: tuple(shape) for key, shape in file["keys"].items()}


def vad_tensor(key: str, shape: tuple[int, ...]) -> np.ndarray:
    """A tensor of a state dict, by its official key and shape."""
    if key.endswith("map_code_weights"):
        return np.ones(shape, np.float32)
    tensor = rule_tensor(key, shape, STEM_GAIN)
    for pattern, factor, offset in _CHANGES:
        if re.fullmatch(pattern, key):
            rows = np.reshape(factor, (-1, *[1] * (len(shape) - 1))) if isinstance(factor, list) else factor
            return (tensor.astype(np.float64) * rows + np.asarray(offset)).astype(np.float32)
    return tensor


def rule_vad() -> VAD:
    """The whole model, in evaluation mode."""
    config = load_config("vad-tiny")
    assert isinstance(config, VADConfig)
    model = VAD(config).eval()
    state = {key: torch.from_numpy(vad_tensor(key, shape)) for key, shape in vad_shapes().items()}
    model.load_state_dict(from_official(state)[0])
    return model


@pytest.mark.slow
def test_an_exported_vad_equals_the_model(mini_vad: VAD, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    file = tmp_path / "vad.onnx"
    export_onnx(mini_vad, file)
    exported = load_exported(file, "onnxruntime")
    drive = MemoryDrive(3)
    *_, last = check_exported(file, Model(mini_vad), drive)
    assert last.further.keys() == {
        "line_class_logits", "line_points", "future_offsets", "mode_logits", "plan_offsets"
    }  # fmt: skip
    assert max(last.further.values()) < 1e-3
    for (_, ours), (_, theirs) in zip(
        run(Model(mini_vad), drive), run(Model(exported, engine="onnxruntime", file=exported.file), drive), strict=True
    ):
        np.testing.assert_allclose(theirs.boxes.scores, ours.boxes.scores, atol=1e-4)
        np.testing.assert_allclose(theirs.boxes.futures, ours.boxes.futures, atol=1e-2)
        (lines, plan), (our_lines, our_plan) = theirs.results, ours.results
        np.testing.assert_allclose(np.stack(lines.points), np.stack(our_lines.points), atol=1e-2)
        assert (lines.classes == our_lines.classes).all()
        np.testing.assert_allclose(plan.paths, our_plan.paths, atol=1e-2)


def test_differences_of_further_outputs_have_columns() -> None:
    frames = [
        FrameDifference(frame, 0, 0, 0, 1, 0, 0, {"plan_offsets": value}) for frame, value in ((3, 0.5), (4, 0.1))
    ]
    heads, *rows = (line.split() for line in difference_lines(frames))
    assert heads[-1] == "plan_offsets"
    assert [(row[0], row[-1]) for row in rows] == [("3", "5.0e-01"), ("4", "1.0e-01"), ("largest", "5.0e-01")]
