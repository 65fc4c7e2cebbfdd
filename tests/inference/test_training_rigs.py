"""A drive's rig is compared with the training of the weights, and its bev frame is levelled where they expect that."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors
import torch
from memory_drive import MemoryDrive, make_camera, make_rig

from bevcli.checkpoints import bundled_weights
from bevcli.config import load_config
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev, level_rig
from bevcli.geometry.transforms import Array, rigid
from bevcli.inference.runner import Runner
from bevcli.model.config import BevFrameConfig, facts_notes, training_rig_notes, weights_facts
from bevcli.model.temporal_model import build_model
from bevcli.workshop.synth.rig import nuscenes_like_rig


def tilted(degrees: float, height_m: float = 1.84) -> Array:
    """The default bev frame, tilted about its x axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    given = default_ego_from_bev()
    given[2, 3] = height_m
    return given @ rigid((0, 0, 0), [[1, 0, 0], [0, c, -s], [0, s, c]])


def with_bev_frame(ego_from_bev: Array) -> CameraRig:
    return replace(nuscenes_like_rig(), ego_from_bev=ego_from_bev)


def test_the_rig_of_the_training_needs_no_note():
    assert training_rig_notes(nuscenes_like_rig(), load_config("demo")) == ()


def test_unlike_cameras_are_told_on_one_line_with_the_cost():
    rig = nuscenes_like_rig()
    higher = [replace(c, ego_from_camera=rigid((0, 0, 2.0)) @ c.ego_from_camera) for c in rig.cameras]
    (note,) = training_rig_notes(CameraRig(tuple(higher), rig.ego_from_bev), load_config("demo"))
    assert "camera heights 3.5 to 3.6 m (0.8 to 2.8 m)" in note
    assert "; measured: mAP" in note
    assert "\n" not in note
    three = [replace(make_camera(f"C{k}", 120.0 * k), name=f"C{k}") for k in range(3)]
    (note,) = training_rig_notes(CameraRig(tuple(three), rig.ego_from_bev), load_config("demo"))
    assert "3 cameras (4 to 8)" in note


def test_a_tilted_bev_frame_is_told_by_what_the_weights_expect():
    (note,) = training_rig_notes(with_bev_frame(tilted(2.7)), load_config("demo"))
    assert "tilted by 2.7° and 1.84 m high, but the weights expect a level one at 1.84 m" in note
    assert training_rig_notes(with_bev_frame(tilted(2.7)), load_config("tiny")) == ()
    (note,) = training_rig_notes(with_bev_frame(tilted(5)), load_config("tiny"))
    assert "boxes 30 m away may be 2.6 m too high or too low" in note


def test_a_bev_frame_is_levelled_with_its_heading_and_origin():
    rig = with_bev_frame(tilted(2.0, height_m=0.3))
    level = level_rig(rig, 1.84).ego_from_bev
    np.testing.assert_allclose(level, default_ego_from_bev(), atol=1e-9)
    assert level_rig(nuscenes_like_rig(), 1.84).ego_from_bev is not level
    own = nuscenes_like_rig()
    assert level_rig(own, 1.84) is own


@pytest.mark.parametrize("ego_from_bev", [tilted(2.7), tilted(-1.5, height_m=0.0)], ids=["tilted", "on the ground"])
def test_boxes_in_ego_do_not_depend_on_the_drives_bev_frame(mini_config, ego_from_bev):
    """A model that expects a level frame predicts the same boxes whatever frame the calibration states."""
    config = replace(mini_config, bev_frame=BevFrameConfig(level=True, height_m=1.84))
    torch.manual_seed(0)
    runner = Runner(build_model(config), torch.device("cpu"))
    found = []
    for frame_of_drive in (default_ego_from_bev(), ego_from_bev):
        drive = MemoryDrive(2, rig=replace(make_rig(), ego_from_bev=frame_of_drive))
        results = [prediction for _, prediction, _ in runner.run(drive, range(2))]
        found.append(results[-1].boxes_ego)
    np.testing.assert_allclose(found[0].centers, found[1].centers, atol=1e-4)
    np.testing.assert_allclose(found[0].yaws, found[1].yaws, atol=1e-4)


def test_the_models_own_weights_state_what_they_expect():
    file = bundled_weights("demo")
    assert file is not None
    with safetensors.safe_open(Path(file), framework="pt") as weights:
        facts = weights.metadata()
    assert facts.items() <= weights_facts(load_config("demo")).items()
    assert facts["bev_frame"] == "level, 1.84 m above the ground"


def test_weights_of_another_bev_frame_than_the_models_are_told():
    assert not list(facts_notes(weights_facts(load_config("demo")), load_config("demo")))
    assert not list(facts_notes({}, load_config("tiny")))
    (note,) = facts_notes(weights_facts(load_config("demo")), load_config("tiny"))
    assert 'trained with a bev frame "level, 1.84 m above the ground"' in note
