"""BEVFormerV2 equals the released code (float32, CPU).

golden_v2.npz in tests/data holds a part of the original's numbers at frame 2: of v2-t1-base the BEV map at every 148th
cell, logits and codes of every 9th query and the boxes; projections and visible pillar points of the frames before
(_1: one frame, _2: two frames). The full numbers are in the folder golden/ of BEVCLI_SHARED.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import original_reference as original
import pytest
import torch

from bevcli.config import load_config
from bevcli.model.pillar_projection import Pillars
from bevcli.model.prepare import prepare_for_inference
from bevcli.workshop.bevformer_v2 import BEVFormerV2

KEPT = np.load(original.DATA / "golden_v2.npz")
SHARED = os.environ.get("BEVCLI_SHARED", "")
FRAME = 2


def test_cropped_images_and_their_projection_equal_the_originals() -> None:
    config = load_config("v2-t1-base")
    images = np.stack([original.network_image(FRAME, name, config) for name in config.cameras])
    np.testing.assert_allclose(images[..., ::64, ::64], KEPT["images"], atol=1e-4)
    np.testing.assert_allclose(original.image_from_bev(FRAME, config), KEPT["image_from_bev"], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("back", [1, 2])
def test_a_history_frame_lies_in_the_bev_as_in_the_original(back: int) -> None:
    found = original.history_image_from_bev(FRAME - back, FRAME, load_config("v2-t8"))
    np.testing.assert_allclose(found, KEPT[f"image_from_bev_{back}"], rtol=0, atol=0.02)  # in float64 it is 0.1 off


@pytest.mark.parametrize("back", [0, 1])
def test_the_same_pillar_points_are_visible_as_in_the_original(back: int) -> None:
    config = load_config("v2-t2")
    matrix = (
        original.history_image_from_bev(FRAME - back, FRAME, config) if back else original.image_from_bev(FRAME, config)
    )
    projection = Pillars(config.bev_grid).project(
        torch.from_numpy(matrix)[None], (640, 1600), torch.ones(1, 6, dtype=torch.bool)
    )
    visible = projection.visible[0].numpy()
    assert visible.any(axis=(1, 2)).all()
    assert np.array_equal(np.packbits(visible), KEPT[f"visible_bits_{back}"])


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("prepared", [False, True])
def test_t1_base_equals_the_original(prepared: bool) -> None:
    model = original.rule_model_v2("v2-t1-base")
    ready = prepare_for_inference(model, torch.device("cpu")) if prepared else model
    assert isinstance(ready, BEVFormerV2)
    with torch.inference_mode():
        outputs = ready(original.window(FRAME, ready))
    np.testing.assert_allclose(outputs.bev[0, :: 4 * 37], KEPT["bev"], atol=1e-3)
    np.testing.assert_allclose(outputs.class_logits[-1, 0, ::9], KEPT["class_logits"], atol=1e-3)
    np.testing.assert_allclose(outputs.box_codes[-1, 0, ::9], KEPT["box_codes"], atol=1e-2)
    check_boxes(model, outputs, KEPT["coder_bboxes"], KEPT["scores_3d"], KEPT["labels_3d"])


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not SHARED, reason="BEVCLI_SHARED is not set: no full numbers of the original")
@pytest.mark.parametrize("name", ["v2-t1-base", "v2-t2", "v2-t8"])
def test_outputs_equal_the_full_numbers(name: str) -> None:
    stem = Path(SHARED) / "golden" / f"golden_{name.replace('-', '_')}"
    facts, arrays = json.loads(stem.with_suffix(".json").read_text()), np.load(stem.with_suffix(".npz"))
    plain = original.rule_model_v2(name)
    model = prepare_for_inference(plain, torch.device("cpu"))
    assert isinstance(model, BEVFormerV2)
    with torch.inference_mode():
        outputs = model(original.window(FRAME, model))
    close(outputs.bev[0, :: facts["bev_row_stride"]], arrays[f"f{FRAME}_bev_embed_sub"], 1e-3)
    logits, codes = (arrays[f"f{FRAME}_{key}"] for key in ("all_cls_scores", "all_bbox_preds"))
    close(outputs.class_logits[-len(logits) :, 0], logits, 1e-3)
    close(outputs.box_codes[-len(codes) :, 0], codes, 1e-2)
    check_boxes(plain, outputs, *(arrays[f"f{FRAME}_{key}"] for key in ("coder_bboxes", "scores_3d", "labels_3d")))


def check_boxes(model: BEVFormerV2, outputs: Any, expected: np.ndarray, scores: np.ndarray, labels: np.ndarray) -> None:
    boxes = outputs.boxes(model.config)
    np.testing.assert_allclose(boxes.scores, scores, atol=1e-4)
    rows = original.match_boxes(boxes, expected, labels, model.config.classes)
    np.testing.assert_allclose(boxes.centers[rows], expected[:, :3], atol=1e-2)
    np.testing.assert_allclose(boxes.sizes_lwh[rows], expected[:, [4, 3, 5]], rtol=1e-3)


def close(found: torch.Tensor, expected: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found.numpy(), expected.reshape(found.shape), atol=tolerance, rtol=0)
