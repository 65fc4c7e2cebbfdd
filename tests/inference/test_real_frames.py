"""Facts about four real nuScenes frames; skipped where they are not at hand."""

import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from bevcli.geometry.cameras import Camera
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import apply, inverse
from bevcli.inference import run
from bevcli.inference.load import load_model
from bevcli.inference.preprocess import Preprocessor, image_from_bev
from bevcli.inference.runner import Runner
from bevcli.sequences.open import open_sequence

# Rectangles (left, top, right, bottom) around objects of frame 0, measured by hand in the enlarged images.
MEASURED = [
    ("CAM_FRONT", "car", (1003, 483, 1075, 531)),
    ("CAM_FRONT", "pedestrian", (1371, 451, 1420, 582)),
    ("CAM_FRONT", "pedestrian", (1249, 474, 1276, 552)),
    ("CAM_BACK", "car", (802, 481, 885, 546)),
    ("CAM_BACK", "car", (928, 479, 1013, 537)),
]


@pytest.fixture(scope="module")
def drive(shared):
    return open_sequence(shared / "data/nuscenes-scene-0103")


@pytest.fixture(scope="module")
def first_frame(drive):
    return drive.load(0)


def rectangles(frame, camera: Camera, kind: str) -> np.ndarray:
    """(K, 4) left, top, right, bottom of the projected ground truth boxes of a class in front of a camera."""
    boxes = frame.ground_truth[frame.ground_truth.classes == kind]
    camera_ego_from_world = inverse(frame.world_from_ego_at[camera.name].matrix)
    pixels, depth = camera.project_ego(apply(camera_ego_from_world, boxes.corners()))
    pixels = pixels[(depth > 1).all(1)]
    return np.concatenate([pixels.min(1), pixels.max(1)], axis=-1)


def overlap(one, other) -> float:
    """Intersection over union of rectangles."""
    low, high = np.maximum(one[:2], other[:2]), np.minimum(one[2:], other[2:])
    shared_area = np.prod(np.maximum(high - low, 0))
    return shared_area / (np.prod(one[2:] - one[:2]) + np.prod(other[2:] - other[:2]) - shared_area)


@pytest.mark.parametrize(("camera", "kind", "measured"), MEASURED)
def test_projected_ground_truth_lies_on_the_objects(first_frame, camera, kind, measured):
    candidates = rectangles(first_frame, first_frame.rig[camera], kind)
    assert max(overlap(np.array(measured, float), c) for c in candidates) > 0.5


def test_pillars_agree_with_opencv_on_the_whole_chain(shared, first_frame):
    """From the files to pixels with SciPy's rotations and OpenCV's projection, none of our geometry."""
    folder = shared / "data/nuscenes-scene-0103"
    calibration = json.loads((folder / "calibration.json").read_text())
    rows = np.genfromtxt(folder / "ego_motion.csv", delimiter=",", names=True, dtype=None)
    times = rows["timestamp_ns"].astype(np.int64)
    slerp = Slerp(times - times[0], Rotation.from_quat(np.stack([rows[f"q{a}"] for a in "xyzw"], -1)))
    places = np.stack([rows[a] for a in "xyz"], -1)

    def pose(time):
        return slerp(time - times[0]), np.array([np.interp(time - times[0], times - times[0], p) for p in places.T])

    def rigid_of(entry):
        return Rotation.from_quat(entry["rotation_wxyz"], scalar_first=True), np.array(entry["translation"])

    pillars = np.random.default_rng(0).uniform([-40, -40, -5], [40, 40, 3], size=(500, 3))
    bev_rotation, bev_place = rigid_of(calibration["ego_from_bev"])
    ego_rotation, ego_place = pose(first_frame.stamp.timestamp_ns)
    world = ego_rotation.apply(bev_rotation.apply(pillars) + bev_place) + ego_place
    for name, entry in calibration["cameras"].items():
        later_rotation, later_place = pose(first_frame.images[name].timestamp_ns)
        camera_rotation, camera_place = rigid_of(entry["ego_from_camera"])
        in_ego = later_rotation.inv().apply(world - later_place)
        in_camera = camera_rotation.inv().apply(in_ego - camera_place)
        ahead = in_camera[:, 2] > 0.5
        expected, _ = cv2.projectPoints(
            in_camera[ahead], np.zeros(3), np.zeros(3), np.array(entry["intrinsics"]), np.zeros(5)
        )
        homogeneous = np.c_[pillars[ahead], np.ones(ahead.sum())] @ image_from_bev(first_frame, name).T
        assert homogeneous[:, :2] / homogeneous[:, 2:3] == pytest.approx(expected[:, 0], abs=1e-3, rel=1e-6)
        assert homogeneous[:, 2] == pytest.approx(in_camera[ahead, 2], abs=1e-6)


@pytest.mark.slow
def test_official_tiny_weights_give_the_official_boxes(shared, first_frame):
    weights = os.environ.get("BEVCLI_OFFICIAL_TINY")
    if not weights:
        pytest.skip("BEVCLI_OFFICIAL_TINY does not name the official weights of tiny")
    at_rest = Kinematics(np.zeros(3), np.zeros(3), np.zeros(3))
    loaded = load_model("tiny", weights)
    runner = Runner(loaded.network, torch.device("cpu"))
    prepared = Preprocessor(runner.config)(replace(first_frame, kinematics=at_rest))
    found = runner.step(None, prepared)[1].boxes
    reference = json.loads((shared / "golden/official_tiny_scene-0103_frame0.json").read_text())
    values = np.array(reference["boxes_3d_values"])
    centers = values[:, :3] + np.c_[np.zeros((60, 2)), values[:, 5] / 2]  # from the bottom to the middle
    names = np.array(reference["class_names"])[reference["labels_3d"]]
    for name, center, score in zip(names, centers, reference["scores_3d"], strict=True):
        near = np.linalg.norm(found.centers - center, axis=1) < 0.3
        assert (near & (found.classes == name) & (np.abs(found.scores - score) < 0.05)).any(), (name, center, score)


@pytest.mark.slow
def test_a_car_that_follows_has_the_velocity_of_its_track(drive):
    model = load_model("photographs")
    *_, (frame, prediction) = run(model, drive)
    world, truth = prediction.boxes_world, frame.ground_truth
    cars, true_cars = (boxes[boxes.classes == "car"] for boxes in (world, truth))
    away = np.linalg.norm(cars.centers[:, None, :2] - true_cars.centers[:, :2], axis=-1)
    follower = np.linalg.norm(true_cars.centers - frame.world_from_ego.translation, axis=1).argmin()
    found = cars.velocities[away[:, follower].argmin()]
    assert found == pytest.approx(true_cars.velocities[follower], abs=2)
    assert np.linalg.norm(found) > 5
    turned = prediction.boxes.transformed(prediction.world_from_ego.matrix @ prediction.ego_from_bev)
    assert turned.velocities == pytest.approx(world.velocities, abs=0.01)
