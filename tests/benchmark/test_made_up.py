"""The benchmark's drive and weights: like a real drive and a trained model in what decides the times."""

from __future__ import annotations

import numpy as np
import torch

from bevcli.benchmark.made_up_drive import MadeUpDrive
from bevcli.benchmark.made_up_model import made_up_model
from bevcli.config import load_config
from bevcli.model.pillar_projection import find_hits, project_pillars
from bevcli.pipeline.preprocess import Preprocessor


def test_cells_are_seen_about_as_often_as_by_nuscenes_cameras():
    config = load_config("tiny")
    prepared = Preprocessor(config)(MadeUpDrive(1).load(0))
    pillars = torch.as_tensor(config.bev_grid.pillars()).float().flatten(0, 1)
    hits = find_hits(project_pillars(prepared.image_from_bev, pillars, (480, 800), prepared.has_image))
    # 2812 on a real nuScenes frame (the reference numbers' first).
    assert 0.95 * 2812 < sum(hits.hits_per_camera) < 1.05 * 2812


def test_images_come_back_from_jpeg_and_differ():
    frame = MadeUpDrive(2).load(1)
    images = [image.pixels_bgr for image in frame.images.values()]
    assert {image.shape for image in images} == {(900, 1600, 3)}
    assert all(image.std() > 20 for image in images)
    assert np.abs(images[0].astype(int) - images[1]).mean() > 20


def test_no_matrix_is_zero_and_weights_are_the_same_every_time(mini_config):
    model, again = made_up_model(mini_config), made_up_model(mini_config)
    assert all(parameter.any() for parameter in model.parameters() if parameter.ndim > 1)
    state = again.state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in model.state_dict().items())
