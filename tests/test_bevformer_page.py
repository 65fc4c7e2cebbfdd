"""docs/bevformer.md: its tables agree with the models, and its links and names exist."""

import re
from pathlib import Path

import pytest
import torch

from bevcli.config import load_config
from bevcli.model.bevformer import BEVFormer
from bevcli.workshop.bevformer_v2 import BEVFormerV2, BEVFormerV2Config

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/bevformer.md"
TEXT = PAGE.read_text(encoding="utf-8")
CAMERAS = 6
MODELS = ("tiny", "base")
V2_MODELS = ("v2-t1", "v2-t2", "v2-t8")


def table_rows(models: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """Name of a tensor or part -> model -> what the page states, in the tables of these models."""
    rows = {}
    for line in TEXT.splitlines():
        cells = [cell.strip().strip("`") for cell in line.strip("|").split("|")]
        titles = ("tensor", "part", "tensor of V2", "---")
        if line.startswith("|") and len(cells) == 1 + len(models) and cells[0] not in titles:
            assert cells[0] not in rows, f"{cells[0]} stands in two tables"
            rows[cells[0]] = dict(zip(models, cells[1:], strict=True))
    return rows


def facts_of_v2(name: str) -> dict[str, str]:
    """What the page should state of a BEVFormerV2."""
    config = load_config(name)
    assert isinstance(config, BEVFormerV2Config)
    width, height = config.image.padded_size
    count, cells = len(config.frames), config.bev_grid.rows * config.bev_grid.columns
    with torch.device("meta"), torch.inference_mode():
        model = BEVFormerV2(config).eval()
        images = torch.zeros(1, CAMERAS, 3, height, width)
        tokens = model.image_features(images, torch.arange(CAMERAS)).tokens
        maps = torch.zeros(count, cells, config.channels)
        fused = None if model.fusion is None else model.fusion(list(maps[:, None]))[0]
    remembered = config.past_frames
    return {
        "cropped images": str(tuple(images[0].shape)),
        "tokens of a frame": str(tuple(tokens.shape)),
        "maps of the window": str(tuple(maps.shape)),
        "input of the fusion": "–"
        if model.fusion is None
        else f"({count * config.channels}, {config.bev_grid.rows}, {config.bev_grid.columns})",
        "output of the fusion": "–" if fused is None else str(tuple(fused.shape)),
        "parameters of the fusion": "–"
        if model.fusion is None
        else f"{sum(parameter.numel() for parameter in model.fusion.parameters()):,}",
        "remembered frames": str(remembered),
        "memory of the window, float32": f"{remembered * tokens.numel() * 4 / 1e6:.0f} MB",
    }


def facts_of(name: str) -> dict[str, str]:
    """What the page should state of a model, from its modules on the meta device and from its configuration."""
    config = load_config(name)
    grid, channels = config.bev_grid, config.channels
    width, height = config.image.padded_size
    with torch.device("meta"), torch.inference_mode():
        model = BEVFormer(config).eval()
        images = torch.zeros(CAMERAS, 3, height, width)
        stages = model.backbone(images)
        levels = model.neck(stages)
        tokens = model.image_tokens(levels, torch.arange(CAMERAS)).tokens
        queries = model.bev_queries(torch.zeros(1, 18))[0]
        position = model.bev_queries.position()
        can_bus = model.bev_queries.can_bus_embedding(torch.zeros(1, 18))[0]
        class_logits, box_codes, _ = model.decoder(queries[None], model.detection_head)
        object_position = model.decoder.query_embedding[:, :channels]
        references = model.decoder.reference_points(object_position)
    pillars = grid.pillars().reshape(-1, grid.pillar_points, 3)
    encoder, decoder = config.encoder, config.decoder
    spatial = (encoder.attention_heads, config.neck.levels, encoder.spatial_points)
    temporal = (encoder.attention_heads, 2, 1, encoder.temporal_points, 2)
    layer = model.encoder.layers[0]
    assert torch.Size((*spatial, 2)).numel() == layer.spatial_cross_attention.attention.sampling_offsets.out_features
    assert torch.Size(temporal).numel() == layer.temporal_self_attention.attention.sampling_offsets.out_features
    stage_of = dict(zip(config.backbone.output_stages, stages, strict=True))
    shapes = {
        "images": images.shape,
        **{f"backbone, stage {stage}": stage_of[stage].shape if stage in stage_of else None for stage in (2, 3, 4)},
        **{f"neck, level {i + 1}": levels[i].shape if i < len(levels) else None for i in range(4)},
        "image tokens": tokens.shape,
        "BEV queries": queries.shape,
        "column embedding": model.bev_queries.column_embedding.shape,
        "row embedding": model.bev_queries.row_embedding.shape,
        "position embedding": position.shape,
        "can-bus numbers": (18,),
        "can-bus embedding": can_bus.shape,
        "shift": (2,),
        "pillar points": pillars.shape,
        "projection matrices": (CAMERAS, 4, 4),
        "reference points in the images": (CAMERAS, len(pillars), grid.pillar_points, 2),
        "spatial sampling points of a cell in a camera": (*spatial, 2),
        "spatial attention weights of a cell in a camera": spatial,
        "history BEV map": queries.shape,
        "temporal value maps": (2, *queries.shape),
        "temporal sampling points of a cell": temporal,
        "BEV map": queries.shape,
        "object queries": model.decoder.query_embedding.shape,
        "object reference points": references.shape,
        "class logits": class_logits[:, 0].shape,
        "box codes": box_codes[:, 0].shape,
    }
    facts = {label: "–" if shape is None else str(tuple(shape)) for label, shape in shapes.items()}
    facts["encoder layers"] = str(len(model.encoder.layers))
    facts["feed-forward width"] = str(layer.feed_forward.expand.out_features)
    facts["decoder layers"] = str(len(model.decoder.layers))
    facts["boxes kept"] = str(decoder.max_boxes)
    for part, module in model.named_children():
        if parameters := sum(parameter.numel() for parameter in module.parameters()):
            facts[part] = f"{parameters:,}"
    facts["all"] = f"{sum(parameter.numel() for parameter in model.parameters()):,}"
    return facts


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_the_tables_state_the_shapes_and_sizes_of_the_models(model):
    assert {label: stated[model] for label, stated in table_rows(MODELS).items()} == facts_of(model)


@pytest.mark.slow
@pytest.mark.parametrize("model", V2_MODELS)
def test_the_table_of_v2_states_shapes_and_sizes_of_its_models(model):
    assert {label: stated[model] for label, stated in table_rows(V2_MODELS).items()} == facts_of_v2(model)


def test_named_classes_and_functions_are_in_the_linked_files():
    named = re.findall(r"`(\w+)` in\s+\[[^\]]+\]\(\.\./([^)]+\.py)\)", TEXT)
    assert len(named) > 20
    for name, file in named:
        assert re.search(rf"^(class|def) {name}\b", (ROOT / file).read_text(), re.MULTILINE), f"{name} in {file}"
