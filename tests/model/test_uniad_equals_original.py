"""UniAD's first stage and its map head equal the released code (float32, CPU); tracks, memory bank, expected places.

golden_uniad_tracks.npz in tests/data holds a part of the original tracker's numbers over 19 frames with given BEV maps:
births, misses, deaths, full memories and a scene change. golden_uniad_map.npz holds a part of its numbers for one BEV
map: the encoder's output at every 592nd cell, every 15th thing query, every fifth mask at every eighth cell, and the
merged map. The full numbers, and those of the whole model over four frames, are in the folder golden/ of BEVCLI_SHARED.
"""

import math
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import original_reference as original
import pytest
import torch
import uniad_reference as reference
from uniad_reference import rule_bev, uniad_state

from bevcli.checkpoints import from_official
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_about_z, rotation_from_quaternion
from bevcli.model.deformable_attention import DeformableAttention
from bevcli.model.kernels.compiled import CompiledSampling
from bevcli.model.kernels.onednn import use_onednn
from bevcli.model.prepare import prepare_for_inference
from bevcli.workshop.uniad.map_head import MapHead, MapHeadConfig, MapOutputs, merge_map, thing_scores
from bevcli.workshop.uniad.uniad import (
    EGO,
    NO_TRACK,
    FrameMotion,
    TrackQueries,
    TrackQueryConfig,
    UniAD,
    UniADOutputs,
    decode_tracks,
    expected_centers,
    live_and_die,
)

KEPT = np.load(original.DATA / "golden_uniad_tracks.npz")


def tracked(model: UniAD) -> Iterator[UniADOutputs]:
    """The outputs of the tracker for each frame of the track-only sequence."""
    tracks = motion = None
    for frame, scene in enumerate(reference.SCENES):
        if tracks is not None and scene != reference.SCENES[frame - 1]:
            tracks = tracks.ended()
        elif frame:
            moved = inverse(reference.world_from_bev(frame)) @ reference.world_from_bev(frame - 1)
            seconds = reference.SECONDS[frame] - reference.SECONDS[frame - 1]
            motion = FrameMotion(torch.from_numpy(moved).float(), seconds)
        with torch.inference_mode():
            outputs = model.track(rule_bev(frame), tracks, motion)
        tracks = outputs.tracks
        yield outputs


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_tracks_equal_the_originals_over_19_frames() -> None:
    model = reference.rule_tracker()
    for frame, outputs in enumerate(tracked(model)):
        expected = {key.partition("_")[2]: KEPT[key] for key in KEPT.files if key.startswith(f"t{frame}_")}
        check_identities(outputs, expected)
        check_boxes(model, outputs, expected)
        tracks, queries = outputs.tracks, torch.cat([outputs.tracks.position, outputs.tracks.content], dim=-1)
        assert np.array_equal(np.packbits(tracks.memories.is_empty.numpy()), expected["mem_pad"])
        assert np.array_equal(tracks.memories.wait, expected["save_period"])
        np.testing.assert_allclose(queries[:, ::128], expected["next_query_sub"], atol=1e-3)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("first_frame", "prefixes"), [("original", "f0 f1 f2 f3"), ("zero", "z0 z1")])
def test_the_whole_model_equals_the_original(shared: Path, first_frame: str, prefixes: str) -> None:
    """Over three frames of a scene and one of another; with motion on first frames as in the original, and without."""
    arrays = np.load(shared / "golden/golden_uniad_stage1.npz")
    plain = reference.rule_uniad(first_frame)
    model = prepare_for_inference(plain, torch.device("cpu"))
    history: torch.Tensor | None = None
    tracks: TrackQueries | None = None
    for frame, prefix in enumerate(prefixes.split()):
        expected = {key.partition("_")[2]: arrays[key] for key in arrays.files if key.startswith(f"{prefix}_")}
        motion = None
        if frame == 3:  # another scene
            assert tracks is not None
            history, tracks = None, tracks.ended()
        elif frame:
            moved = inverse(world_from_bev(frame)) @ world_from_bev(frame - 1)
            motion = FrameMotion(torch.from_numpy(moved).float(), float(expected["time_delta"][0]))
        inputs = original.inputs(frame, plain.config, all_frames=first_frame == "original")
        close(inputs.can_bus[0], expected["can_bus_in"].astype(np.float32), 1e-4)
        close(inputs.shift, expected["shift"], 1e-5)
        with torch.inference_mode():
            outputs = model(inputs, history, tracks, motion)
        rows = 37 if prefix.startswith("f") else 148
        close(outputs.bev[0, ::rows], expected["bev_embed_sub"], 1e-3)
        close(outputs.class_logits[-1, 0], expected["all_cls_scores"], 1e-3)
        check_codes(outputs.box_codes[-1, 0], expected["all_bbox_preds"])
        check_identities(outputs, expected)
        check_boxes(plain, outputs, expected)
        check_map(plain, outputs, expected)
        history, tracks = outputs.bev, outputs.tracks


def world_from_bev(frame: int) -> Array:
    """(4, 4) of one of the four frames."""
    info = original.frames()[frame]
    ego_from_bev = rigid(info["lidar2ego_translation"], rotation_from_quaternion(info["lidar2ego_rotation"]))
    return original.pose(frame).matrix @ ego_from_bev


def check_identities(outputs: UniADOutputs, expected: Mapping[str, Any]) -> None:
    assert np.array_equal(outputs.ids, expected["obj_idxes"])
    assert np.array_equal(outputs.tracks.misses, expected["disappear_time"][expected["obj_idxes"] >= 0])


def check_boxes(model: UniAD, outputs: UniADOutputs, expected: Mapping[str, Any]) -> None:
    boxes = decode_tracks(outputs, model.config)
    np.testing.assert_allclose(boxes.scores, expected["scores_3d_det"], atol=1e-4)
    assert boxes.instances is not None
    row_of = {name: row for row, name in enumerate(boxes.instances) if name}
    assert row_of.keys() == {str(name) for name in expected["track_ids"]}
    boxes, original_boxes = boxes[[row_of[str(name)] for name in expected["track_ids"]]], expected["boxes_3d"]
    assert np.array_equal(boxes.classes, np.array(model.config.classes)[expected["labels_3d"]])
    np.testing.assert_allclose(boxes.scores, expected["scores_3d"], atol=1e-4)
    bottoms = boxes.centers - boxes.sizes_lwh * (0, 0, 0.5)
    np.testing.assert_allclose(bottoms, original_boxes[:, :3], atol=1e-2)
    np.testing.assert_allclose(boxes.sizes_lwh[:, [1, 0, 2]], original_boxes[:, 3:6], rtol=1e-3, atol=1e-2)
    turned = boxes.yaws - (-original_boxes[:, 6] - np.pi / 2)  # the original measures clockwise from -y
    np.testing.assert_allclose(np.sin(turned), 0, atol=1e-2)
    assert (np.cos(turned) > 0).all()
    np.testing.assert_allclose(boxes.velocities, original_boxes[:, 7:], atol=1e-2)


def check_codes(found: torch.Tensor, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, atol=1e-2, rtol=0)


def check_map(model: UniAD, outputs: UniADOutputs, expected: Mapping[str, Any]) -> None:
    config, found = model.config, outputs.map
    assert found is not None
    close(found.class_logits[0], expected["seg_cls"], 1e-3)
    close(found.locations[-1, 0], expected["seg_box"], 1e-4)
    merged = merge_map(found, config.map_head, config.bev_grid)
    cells = (config.bev_grid.rows, config.bev_grid.columns)
    lanes = np.unpackbits(expected["lane_bits"])[: 3 * merged.things[0].size].reshape(3, *cells)
    drivable = np.unpackbits(expected["drivable_bits"])[: merged.stuff[0].size].reshape(cells)
    # A few cells of the original's masks are within 1e-5 of the threshold.
    assert (merged.things != lanes).sum() <= 20
    assert (merged.stuff[0] != drivable).sum() <= 3
    assert np.array_equal(merged.instances, expected["id_map"]) or (merged.instances != expected["id_map"]).sum() <= 20


def close(found: torch.Tensor, expected: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found.numpy(), expected.reshape(found.shape), atol=tolerance, rtol=0)


CONFIG = TrackQueryConfig(birth_score=0.4, keep_score=0.35, max_misses=5)
STANDING = FrameMotion(torch.eye(4), 0.5)


def step(ids: list[int], misses: list[int], scores: list[float], next_id: int = 7) -> tuple[list[int], list[int], int]:
    found, count, after = live_and_die(*map(torch.tensor, (ids, misses, scores)), next_id, CONFIG)
    return found.tolist(), count.tolist(), after


def test_queries_without_a_track_start_one_from_the_birth_score() -> None:
    ids, _, after = step([NO_TRACK] * 4, [0] * 4, [0.39, 0.4, 0.1, 0.9])
    assert ids == [NO_TRACK, 7, NO_TRACK, 8]
    assert after == 9


def test_the_ego_query_never_becomes_a_track() -> None:
    assert step([EGO], [0], [0.99]) == ([EGO], [0], 7)


def test_a_track_ends_with_its_fifth_miss_also_not_consecutive() -> None:
    ids, misses = [3], [0]
    for score, alive in [(0.1, True), (0.1, True), (0.37, True), (0.1, True), (0.1, True), (0.36, True), (0.1, False)]:
        ids, misses, _ = step(ids, misses, [score])
        assert (ids == [3]) is alive
    assert ids == [NO_TRACK]


def codes(*rows: tuple[float, float, float, float, float]) -> torch.Tensor:
    """Box codes of x, y, z, vx, vy."""
    found = torch.zeros(len(rows), 10)
    found[:, [0, 1, 4, 8, 9]] = torch.tensor(rows).float()
    return found


def test_an_object_is_expected_where_its_velocity_takes_it() -> None:
    found = expected_centers(codes((1, 2, 3, 4, -2)), STANDING)
    assert found[0].tolist() == pytest.approx([3, 1, 3])


def test_a_standing_object_is_expected_where_the_vehicle_sees_it() -> None:
    """The vehicle has driven 4 m ahead (y) and turned left by 90 degrees: what was 10 m ahead is 6 m to the right."""
    previous_from_now = rigid((0, 4, 0), rotation_about_z(math.pi / 2))
    matrix = torch.from_numpy(np.linalg.inv(previous_from_now)).float()
    found = expected_centers(codes((0, 10, -1, 0, 0)), FrameMotion(matrix, 0.5))
    assert found[0].tolist() == pytest.approx([6, 0, -1], abs=1e-5)


KEPT_MAP = np.load(original.DATA / "golden_uniad_map.npz")
FRAME = 5
GRID, MAP_CONFIG = BevGrid(200, 200), MapHeadConfig()
PREFIX = "map_head."


class Step(NamedTuple):
    """What the head computed.

    Attributes:
        outputs: of the head.
        memory: (Y·X, C) of the encoder.
        queries: (T, C) of the location decoder.
        things: (K, C) of the last layer of the things' mask decoder.
        stuff: (S, C) of the last layer of the stuff's mask decoder.
    """

    outputs: MapOutputs
    memory: torch.Tensor
    queries: torch.Tensor
    things: torch.Tensor
    stuff: torch.Tensor


@cache
def map_step(prepared: bool) -> Step:
    """One step with weights by the rule. prepared: with the kernels of inference on a CPU."""
    head = MapHead(MAP_CONFIG, 256, GRID).eval().requires_grad_(False)
    state = from_official(uniad_state("seg_head."))[0]
    head.load_state_dict({key.removeprefix(PREFIX): tensor for key, tensor in state.items()})
    parts = (head.encoder, head.location_decoder.layers[-1], head.thing_masks.layers[-1], head.stuff_masks.layers[-1])
    found: dict[int, torch.Tensor] = {}
    for index, part in enumerate(parts):
        part.register_forward_hook(lambda *call, index=index: found.update({index: call[-1][0].clone()}))
    if prepared:
        use_onednn(head)
        for module in head.modules():
            if isinstance(module, DeformableAttention):
                module.sampling = CompiledSampling()
    with torch.inference_mode():
        outputs = head(rule_bev(FRAME))
    return Step(outputs, found[0], found[1], found[2], found[3])


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("prepared", [False, True])
def test_embeddings_things_and_masks_equal_the_originals(prepared: bool) -> None:
    found = map_step(prepared)
    close(found.memory[:: 37 * 16], KEPT_MAP["memory"], 1e-3)
    close(found.queries[::15], KEPT_MAP["queries"], 1e-3)
    close(found.outputs.class_logits[0], KEPT_MAP["class_logits"], 1e-3)
    close(found.outputs.locations[-1, 0] * 102.4, KEPT_MAP["box"] * 102.4, 1e-2)  # metres
    rows = matching_rows(found.outputs)
    masks = found.outputs.thing_masks[0, rows].unflatten(-1, (200, 200))
    close(found.outputs.scores[0, rows], KEPT_MAP["scores"], 1e-4)
    close(found.things[rows][::5, ::4], KEPT_MAP["things"], 1e-3)
    close(found.stuff, KEPT_MAP["stuff"], 1e-3)
    close(masks[::5, ::8, ::8], KEPT_MAP["thing_masks"], 1e-3)
    close(found.outputs.stuff_masks[0, 0].unflatten(-1, (200, 200))[::4, ::4], KEPT_MAP["stuff_mask"], 1e-3)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("prepared", [False, True])
def test_the_merged_map_equals_the_originals(prepared: bool) -> None:
    outputs = map_step(prepared).outputs
    merged = merge_map(outputs, MAP_CONFIG, GRID)
    assert_same_cells(merged.things, np.unpackbits(KEPT_MAP["lane_bits"]).reshape(3, 200, 200))
    assert_same_cells(merged.stuff[0], np.unpackbits(KEPT_MAP["drivable_bits"]).reshape(200, 200))
    assert_same_cells(merged.instances, KEPT_MAP["ids"])
    assert_same_cells(np.array([0, *merged.instance_labels])[merged.instances], KEPT_MAP["label_map"])
    scores, order = thing_scores(outputs.thing_masks[0], outputs.scores[0], MAP_CONFIG.min_mask).sort(descending=True)
    close(scores, KEPT_MAP["final_scores"], 2e-4)  # the class score times the square of a mean of masks
    assert np.mean(outputs.labels[0, order].numpy() == KEPT_MAP["final_labels"]) > 0.9  # neighbours may be 4e-7 apart
    np.testing.assert_allclose(
        merged.instance_scores, KEPT_MAP["final_scores"][: len(merged.instance_scores)], atol=2e-4
    )


def matching_rows(outputs: MapOutputs) -> list[int]:
    """For each thing that the original selected, the index of ours with its query and class."""
    found = {
        pair: row for row, pair in enumerate(zip(outputs.queries[0].tolist(), outputs.labels[0].tolist(), strict=True))
    }
    return [found[pair] for pair in zip(KEPT_MAP["index"].tolist(), KEPT_MAP["labels"].tolist(), strict=True)]


def assert_same_cells(found: np.ndarray, expected: np.ndarray) -> None:
    """Cells are equal, but for those where a mask is so near to its threshold that rounding decides."""
    assert found.shape == expected.shape
    assert np.count_nonzero(found != expected) <= 5
