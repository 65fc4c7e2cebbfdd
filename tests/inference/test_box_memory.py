"""The boxes that a run remembers: out of view, missed, better known than guessed, and after an interruption."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_boxes import made_boxes
from memory_drive import MemoryDrive, make_rig
from stepping import run

from bevcli.frame import Frame, Prediction
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose, inverse
from bevcli.inference.box_memory import BoxMemory, remember
from bevcli.model.bevformer import BEVFormer
from bevcli.model.decoder import DecoderConfig

FRONT = make_rig({"CAM_FRONT": 0})  # it sees 5 / 8 of the depth to each side
AHEAD, BEHIND = (12.0, 0.0, 0.7), (-8.0, 3.0, 0.7)  # places that it sees and does not see, ego frame
FADE_S = 10.0
CONFIG = DecoderConfig(remember_s=FADE_S, max_boxes=20)


def step(memory: BoxMemory | None, boxes: Boxes3D, seconds: float = 0.0, x: float = 0.0) -> tuple[BoxMemory, Boxes3D]:
    """The memory after a frame, and its boxes in the ego frame. x: of the vehicle; boxes: ego frame."""
    frame = MemoryDrive(1, rig=FRONT).load(0)
    pose = Pose(np.array([x, 0.0, 0.0]), np.array([1.0, 0, 0, 0]))
    stamp = replace(frame.stamp, timestamp_ns=round(seconds * 1e9))
    frame = replace(frame, stamp=stamp, world_from_ego=pose, world_from_ego_at={"CAM_FRONT": pose})
    memory, after = remember(memory, frame, prediction_of(frame, boxes), CONFIG)
    return memory, after.boxes_ego


def prediction_of(frame: Frame, boxes: Boxes3D) -> Prediction:
    ego_from_bev = frame.rig.ego_from_bev
    grid, in_bev = BevGrid(64, 64, (-32.0, 32.0), (-32.0, 32.0)), boxes.transformed(inverse(ego_from_bev))
    return Prediction(frame.stamp, in_bev, ego_from_bev, frame.world_from_ego, grid, bev=None, started_anew=None)


def cars(*places: tuple[float, float, float], **columns: object) -> Boxes3D:
    return made_boxes(list(places), **{"scores": 0.8, **columns})


def test_what_leaves_the_view_is_remembered_where_it_drives():
    memory, first = step(None, cars(AHEAD, velocities=(3.0, 1.0)))
    assert first.scores.tolist() == [0.8]
    memory, second = step(memory, cars(), seconds=1.0, x=20.0)  # the vehicle has passed it
    np.testing.assert_allclose(second.centers, [[12 + 3 - 20, 1, 0.7]], atol=1e-9)
    np.testing.assert_allclose(second.scores, 0.8 * np.exp(-1 / FADE_S))
    memory, third = step(memory, cars(), seconds=2.0, x=20.0)
    np.testing.assert_allclose(third.centers, [[12 + 6 - 20, 2, 0.7]], atol=1e-9)
    assert len(step(memory, cars(), seconds=3.0, x=60.0)[1]) == 0  # beyond the map
    assert len(step(memory, cars(), seconds=40.0, x=20.0)[1]) == 0  # faded


def test_what_the_model_misses_once_loses_half_and_is_found_again():
    memory, _ = step(None, cars(AHEAD))
    memory, missed = step(memory, cars())
    np.testing.assert_allclose(missed.scores, [0.4])
    memory, found = step(memory, cars((12.5, 0.2, 0.7), scores=0.3))
    np.testing.assert_allclose(found.centers, [[12.5, 0.2, 0.7]])  # where a camera looks the model is believed
    assert found.scores.tolist() == [0.3]
    for _ in range(3):
        memory, found = step(memory, cars())
    assert len(found) == len(memory.boxes) == 0


@pytest.mark.parametrize(("guess", "place"), [(0.5, AHEAD), (0.99, BEHIND)])
def test_a_guess_where_no_camera_looks_counts_half_and_yields_to_what_was_seen(guess, place):
    seen = cars(AHEAD, scores=0.3)
    memory, _ = step(None, seen)
    behind = (AHEAD[0] - 20, 0.5, 0.7)
    _, after = step(memory, cars(behind, scores=guess), x=20.0)
    known = guess / 2 < 0.3
    np.testing.assert_allclose(after.centers[0, 1], 0.0 if known else 0.5)
    assert after.scores.tolist() == [0.3 if known else guess / 2]
    assert len(after) == 1


def test_guesses_are_not_remembered_and_other_classes_and_places_are_no_duplicates():
    memory, guessed = step(None, cars(BEHIND))
    assert (guessed.scores.tolist(), len(memory.boxes)) == ([0.4], 0)
    memory, _ = step(None, cars(AHEAD, (12.0, 3.0, 0.7), classes=["car", "truck"]))
    _, after = step(memory, cars((-8.0, 1.9, 0.7), (-8.0, 0.1, 0.7), classes=["car", "bus"]), x=20.0)
    names = after.classes.tolist()
    assert sorted(names) == ["bus", "car", "truck"]  # the car 1.9 m beside the one that is remembered gives way
    assert names[-1] == "bus"
    assert (np.diff(after.scores) <= 0).all()


def test_a_black_image_sees_nothing():
    frame = MemoryDrive(1).load(0)
    boxes = cars(AHEAD).transformed(frame.world_from_ego.matrix)
    dead = replace(frame.images["CAM_FRONT"], pixels_bgr=np.full((180, 320, 3), 3, np.uint8))
    assert frame.sees(boxes).tolist() == [True]
    assert not replace(frame, images=frame.images | {"CAM_FRONT": dead}).sees(boxes).any()


def test_a_run_remembers_within_a_scene_and_goes_on_as_without_interruption(mini_config):
    config = replace(mini_config, decoder=replace(mini_config.decoder, remember_s=FADE_S))
    torch.manual_seed(0)
    model, plain = BEVFormer(config), BEVFormer(mini_config)
    torch.nn.init.zeros_(model.detection_head.class_branches[-1][-1].bias)  # scores around one half
    plain.load_state_dict(model.state_dict())
    drive = MemoryDrive(5, rig=FRONT, scenes="aaabb")
    whole, state = run(model, drive, unseen=True)
    assert state.boxes is not None
    without, _ = run(plain, drive, unseen=True)
    same = [places_of(one) == places_of(other) for one, other in zip(whole, without, strict=True)]
    assert same == [True, False, False, True, False]  # a scene begins with the fourth
    for prediction in whole:
        assert (np.diff(prediction.boxes.scores) <= 0).all()
        assert len(prediction.boxes) <= config.decoder.max_boxes
    begin, halfway = run(model, drive, range(2), unseen=True)
    end, _ = run(model, drive, range(2, 5), halfway, unseen=True)
    for one, other in zip(whole, (*begin, *end), strict=True):
        assert np.array_equal(one.boxes.centers, other.boxes.centers)
    single, state = run(model, drive, temporal=False, unseen=True)
    assert [len(each.boxes) for each in single] == [len(each.boxes) for each in without]
    assert state.boxes is None


def places_of(prediction: Prediction) -> set[tuple[float, ...]]:
    return {tuple(center) for center in prediction.boxes.centers.tolist()}
