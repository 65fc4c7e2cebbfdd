"""The benchmark's drive and weights resemble a real drive and a trained model in everything that affects times."""

import pytest
import torch

from bevcli.config import load_config
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.pillar_projection import find_hits, project_pillars
from bevcli.workshop.benchmark.versions import MadeUpDrive, made_up_model


@pytest.mark.slow
def test_the_cameras_see_about_as_many_cells_as_nuscenes():
    config = load_config("tiny")
    prepared = Preprocessor(config)(MadeUpDrive(1).load(0))
    pillars = torch.as_tensor(config.bev_grid.pillars()).float().flatten(0, 1)
    hits = find_hits(project_pillars(prepared.image_from_bev, pillars, (480, 800), prepared.has_image))
    # 2812 in a real nuScenes frame, the first of the reference numbers.
    assert 0.95 * 2812 < sum(hits.hits_per_camera) < 1.05 * 2812


def test_no_matrix_is_zero_and_every_call_gives_the_same_weights(mini_config):
    model, again = made_up_model(mini_config), made_up_model(mini_config)
    assert all(parameter.any() for parameter in model.parameters() if parameter.ndim > 1)
    state = again.state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in model.state_dict().items())
