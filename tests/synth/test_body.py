"""A body that pitches and rolls: images follow it, boxes stay where they are, and poses state it or not."""

from dataclasses import replace

import numpy as np
import pytest
from same_world import outside_of_boxes

from bevcli.config import load_config
from bevcli.frame import CameraImage, Frame
from bevcli.geometry.cameras import level_rig
from bevcli.geometry.transforms import Pose, apply, inverse, rigid, rotation_about_z
from bevcli.inference.preprocess import Preprocessor, network_from_image
from bevcli.sequences.images import AT_REST
from bevcli.sequences.open import open_sequence
from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.city import Route
from bevcli.workshop.synth.drive import MOST_DEG, BodyMotion, RenderedDrive, RenderedFrame, export_drive
from bevcli.workshop.synth.rig import DrawnRig, RigDistribution, draw_rig, nuscenes_like_rig, tilt
from bevcli.workshop.synth.traffic import EgoTrack
from bevcli.workshop.training.targets import ground_truth_boxes

PITCHED = 13  # a frame of seed 113 in which the vehicle brakes


def drive_with(body: str, assets: Assets) -> RenderedDrive:
    rig = DrawnRig(nuscenes_like_rig(320, 180), body=body)
    return RenderedDrive(113, frames=20, rig=rig, assets=assets, weather="noon")


@pytest.fixture(scope="module")
def moving(assets: Assets) -> RenderedDrive:
    return drive_with("moving", assets)


@pytest.fixture(scope="module")
def pitched(moving: RenderedDrive) -> RenderedFrame:
    return moving.frame(PITCHED)


def turns_deg(drive: RenderedDrive) -> np.ndarray:
    """(F, 2) pitch (nose down) and roll (right side down) of the true poses of the frames."""
    upward = [drive.world_from_ego(drive.time_s(k)).matrix[2, :3] for k in range(drive.frames)]
    return np.degrees([(-np.arcsin(up[0]), np.arctan2(up[1], up[2])) for up in upward])


def test_pitch_and_roll_are_those_of_a_car(moving):
    turns = turns_deg(moving)
    assert (np.abs(turns).max(0) <= MOST_DEG).all()
    assert turns.std(0).max() > 0.1
    heights = [apply(moving.world_from_ego(moving.time_s(k)).matrix, (1.4, 0, 0))[2] for k in range(moving.frames)]
    assert np.abs(heights).max() < 0.05


def mean_turns_deg(speeds: np.ndarray, yaw_rate: float) -> np.ndarray:
    """(T, 2) mean pitch and roll of 60 bodies, every 0.1 s, on a way of constant yaw rate. speeds: (T,) m/s."""
    times = 0.1 * np.arange(len(speeds))
    way, yaws = np.cumsum(speeds) * 0.1, yaw_rate * times
    points = np.cumsum(0.1 * speeds[:, None] * np.stack([np.cos(yaws), np.sin(yaws)], -1), axis=0)
    ego = EgoTrack(Route(points, yaws, speeds, ()), np.stack([times, way, speeds]))
    bodies = [BodyMotion.draw(ego, np.random.default_rng(seed)) for seed in range(60)]
    return np.degrees(np.mean([[np.interp(times, b.times, turn) for turn in b.turns.T] for b in bodies], axis=0)).T


@pytest.mark.slow
def test_the_nose_goes_down_under_braking_and_the_body_leans_out():
    braking = mean_turns_deg(np.concatenate([np.full(40, 12.0), np.linspace(12, 3, 30), np.full(50, 3.0)]), 0.0)
    assert braking[50:68, 0].min() > 0.3  # 3 m/s²
    assert np.abs(np.concatenate([braking[20:38], braking[100:115]])).max() < 0.2
    left_turn = mean_turns_deg(np.full(80, 6.0), 0.4)
    assert left_turn[30:75, 1].min() > 0.3  # 2.4 m/s² to the left: the right side goes down


def test_boxes_contain_their_pixels_where_the_body_pitches(moving, pitched):
    """As they do on a still body: with the true pose. With a level one they are off."""
    true = pitched.world_from_ego
    level = Pose.from_matrix(rigid(true.translation, rotation_about_z(true.yaw)))
    poses = {"true": true, "level": level}
    outside = {kind: outside_of_boxes(moving, PITCHED, pitched, pose) for kind, pose in poses.items()}
    assert len(outside["true"]) > 20
    assert min(outside["true"]) > -0.6
    assert min(outside["level"]) < -2


@pytest.mark.slow
def test_unstated_motion_shows_in_images_but_not_in_poses(moving, pitched, assets, drive):
    unstated = drive_with("unstated", assets)
    frame = unstated.frame(PITCHED)
    assert all(np.array_equal(frame.images[name], image) for name, image in pitched.images.items())
    assert np.array_equal(frame.boxes.centers, pitched.boxes.centers)
    assert frame.world_from_ego.matrix[2].tolist() == [0, 0, 1, 0]
    poses, level = unstated.ego_motion(), drive.ego_motion()
    assert np.abs(poses.translations - level.translations).max() < 1e-3
    assert np.abs(poses.quaternions - level.quaternions).max() < 1e-9
    assert np.array_equal(poses.velocities, level.velocities)
    assert np.abs(moving.ego_motion().quaternions[:, 1:3]).max() > 1e-3


def test_a_share_of_the_drives_of_a_training_moves():
    some = RigDistribution(moving_share=0.6)
    drawn = [draw_rig(some, seed, (160, 90)) for seed in range(400)]
    shares = {kind: np.mean([each.body == kind for each in drawn]) for kind in ("still", "moving", "unstated")}
    assert shares == pytest.approx({"still": 0.4, "moving": 0.3, "unstated": 0.3}, abs=0.06)
    for seed, each in enumerate(drawn):  # all else stays
        without = draw_rig(RigDistribution(), seed, (160, 90))
        assert (without.delays_s, without.jpeg_quality, without.body) == (each.delays_s, each.jpeg_quality, "still")
    assert RigDistribution(unstated_share=0.2).digest == RigDistribution().digest != some.digest


def test_a_levelled_bev_frame_projects_points_where_images_show_them(moving, pitched):
    """Its z axis is that of the road, and a point of the world has one pixel, whatever the frame."""
    motion, stamp, boxes = moving.ego_motion(), pitched.stamp, pitched.boxes
    images = {name: CameraImage(stamp.timestamp_ns, image) for name, image in pitched.images.items()}
    frame = Frame(
        stamp, moving.rig, images, pitched.world_from_ego, pitched.world_from_ego_at, AT_REST, ground_truth=boxes,
        road_normal=motion.road_normal_at(stamp.timestamp_ns),
    )  # fmt: skip
    config, camera, upward = load_config("demo"), frame.rig["CAM_FRONT"], []
    pixels, depth = camera.project_ego(apply(inverse(frame.world_from_ego.matrix), boxes.centers))
    assert (depth > 1).sum() > 5
    expected = apply(network_from_image(camera, config.image), np.insert(pixels, 2, 1, axis=1))[depth > 1, :2]
    for follow_road in (False, True):
        bev_frame = replace(config.bev_frame, follow_road=follow_road)
        prepared = Preprocessor(replace(config, bev_frame=bev_frame), threads=1)(frame)
        upward.append((prepared.frame.world_from_ego.matrix @ prepared.frame.rig.ego_from_bev)[:3, 2])
        projection = prepared.image_from_bev[0, prepared.assignment.cameras.index("CAM_FRONT")].numpy()
        shown = apply(projection, ground_truth_boxes(prepared.frame).centers)[depth > 1]
        np.testing.assert_allclose(shown[:, :2] / shown[:, 2:], expected, atol=1e-6)
    mean = np.mean([moving.stated_pose(k / 50).matrix[:3, 2] for k in range(75, 476)], axis=0)  # 1.5 to 9.5 s
    np.testing.assert_allclose(upward[0], frame.world_from_ego.matrix[:3, 2], atol=1e-9)
    np.testing.assert_allclose(upward[1], mean / np.linalg.norm(mean), atol=2e-4)


@pytest.mark.slow
def test_a_drive_that_is_read_has_the_road_of_its_poses(assets, tmp_path):
    rig = DrawnRig(nuscenes_like_rig(160, 90), body="moving")
    drive = RenderedDrive(5, frames=2, rig=rig, assets=assets)
    export_drive(drive, tmp_path / "drive")
    frame = open_sequence(tmp_path / "drive").load(1)
    expected = drive.ego_motion().road_normal_at(frame.stamp.timestamp_ns)
    np.testing.assert_allclose(frame.road_normal, expected, atol=1e-6)
    assert frame.road_normal[2] < 1


def test_a_level_drive_is_levelled_as_without_its_poses(drive):
    tilted = replace(drive.rig, ego_from_bev=drive.rig.ego_from_bev @ rigid((0, 0, 0), tilt(0.03, 0.02)))
    level = level_rig(tilted, 1.84).ego_from_bev
    np.testing.assert_allclose(level_rig(tilted, 1.84, np.array([0.0, 0.0, 1.0])).ego_from_bev, level, atol=1e-12)
    assert level_rig(drive.rig, 1.84, np.array([0.0, 0.0, 1.0])) is drive.rig
