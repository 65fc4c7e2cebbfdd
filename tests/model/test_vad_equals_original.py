"""VAD-tiny equals the released code, from images to the planned path (float32, CPU).

golden_vad.npz in tests/data holds a part of the original's numbers for the first two frames; all numbers of four frames
are in the folder golden/ of BEVCLI_SHARED.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import original_reference as original
import pytest
import torch
from vad_rule import rule_vad, vad_shapes

from bevcli.checkpoints import expected_state, from_official
from bevcli.config import load_config
from bevcli.model.prepare import prepare_for_inference
from bevcli.workshop.vad.vad import VAD, VADOutputs, decode_futures, decode_lines, line_positions

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
