"""The ground truth of a drive agrees with its images, with its motion over time, and with its map."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from same_world import outside_of_boxes, projected, with_rig
from shapely import Polygon

from bevcli.geometry.cameras import CameraRig, Distortion
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import inverse, wrap_angle
from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.drive import ANNOTATED_M, RenderedDrive, RenderedFrame
from bevcli.workshop.synth.rig import nuscenes_like_rig
from bevcli.workshop.synth.traffic import ActorState


@pytest.mark.slow
def test_same_seed_gives_the_same_bytes(drive: RenderedDrive, frame: RenderedFrame, assets: Assets):
    """Independent of the frames rendered before, and of the number of threads."""
    two = CameraRig(drive.rig.cameras[:2], drive.rig.ego_from_bev)
    again = RenderedDrive(113, frames=20, rig=two, assets=assets, weather="noon", threads=2)
    again.frame(2)
    other = again.frame(9)
    for name, image in other.images.items():
        assert image.tobytes() == frame.images[name].tobytes()
    assert frame.boxes.centers.tobytes() == other.boxes.centers.tobytes()
    assert frame.bev_map.cells.tobytes() == other.bev_map.cells.tobytes()


def test_projected_box_contains_the_objects_pixels(drive: RenderedDrive, frame: RenderedFrame):
    outside = outside_of_boxes(drive, 9, frame, frame.world_from_ego)
    assert len(outside) > 40
    assert min(outside) > -0.6


def test_visibility_agrees_with_rendering_each_object_alone(drive: RenderedDrive, frame: RenderedFrame):
    """The visibility is the number of pixels seen over the number of pixels of the object drawn alone by OpenCV."""
    states = [state for _, state in drive._actors(9)]
    rows = {instance: k for k, instance in enumerate(frame.boxes.instances)}
    checked = 0
    for k, state in enumerate(states):
        row = rows.get(state.body.instance)
        solid = state.body.variant.class_name in ("car", "truck", "bus", "trailer")  # OpenCV draws thin bars too wide
        if row is None or not solid or frame.boxes.num_points[row] < 300:
            continue
        alone = sum(int(_silhouette(drive, state, camera, frame).sum()) for camera in drive.rig.cameras)
        shown = sum(int((e.objects == k).sum()) for e in frame.views.values())
        assert frame.boxes.num_points[row] == shown
        assert frame.boxes.visibilities[row] == pytest.approx(shown / alone, abs=0.04)
        checked += 1
    assert checked >= 3


def _silhouette(drive: RenderedDrive, state: ActorState, camera, frame: RenderedFrame):
    """(H, W) bool mask of an object without occlusion, filled triangle by triangle with OpenCV."""
    faces = drive._template(state.body, state.pose).corners.astype(np.float64)
    c, s = np.cos(state.yaw), np.sin(state.yaw)
    world = faces @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + state.position
    fine = 8
    mask = np.zeros((camera.height * fine, camera.width * fine), np.uint8)
    pixels, depths = projected(world.reshape(-1, 3), camera, frame.world_from_ego)
    pixels, depths = pixels.reshape(-1, 3, 2), depths.reshape(-1, 3)
    for triangle, depth in zip(pixels, depths, strict=True):
        if depth.min() > 0.2 and np.abs(triangle).max() < 5000:
            cv2.fillConvexPoly(mask, np.round(((triangle + 0.5) * fine - 0.5) * 16).astype(np.int32), 1, cv2.LINE_8, 4)
    return mask[fine // 2 :: fine, fine // 2 :: fine] > 0


def test_velocities_are_differences_of_positions(drive: RenderedDrive):
    """Differences over 0.1 s, except for objects whose velocity changes in this time."""
    rate = drive.rate_hz
    h, checked = 0.05, 0
    for index in (3, 9, 15):
        time_s = index / rate
        origin = drive.world_from_ego(time_s).translation[:2]
        for actor in drive.simulation.actors_near(origin, 60):
            states = [actor.state(time_s + d) for d in (-h, 0.0, h)]
            if any(s is None for s in states):
                continue
            if max(np.hypot(*(s.velocity - states[1].velocity)) for s in states) > 0.25:
                continue  # people start and stop within one simulation step
            difference = (states[2].position - states[0].position)[:2] / (2 * h)
            assert np.hypot(*(difference - states[1].velocity)) < 0.2
            checked += bool(np.hypot(*difference) > 1)
    assert checked > 20


def test_a_turn_moves_standing_boxes_in_ego_but_not_world_frame(drive: RenderedDrive, assets: Assets):
    turning = max(range(19), key=lambda k: _turned(drive, k))
    assert _turned(drive, turning) > np.radians(5)
    front = with_rig(drive, CameraRig(drive.rig.cameras[:1], drive.rig.ego_from_bev))
    first, second = front.frame(turning), front.frame(turning + 1)
    one = {i: k for k, i in enumerate(first.boxes.instances)}
    shared = [
        (one[i], k) for k, i in enumerate(second.boxes.instances)
        if i in one and i.startswith(("parked", "cone", "barrier", "machine", "rack", "fence", "site"))
    ]  # fmt: skip
    assert len(shared) > 5
    a, b = np.array(shared).T
    np.testing.assert_array_equal(first.boxes.centers[a], second.boxes.centers[b])
    np.testing.assert_array_equal(first.boxes.yaws[a], second.boxes.yaws[b])
    ego_a = first.boxes[a].transformed(inverse(first.world_from_ego.matrix))
    ego_b = second.boxes[b].transformed(inverse(second.world_from_ego.matrix))
    turn = wrap_angle(second.world_from_ego.yaw - first.world_from_ego.yaw)
    np.testing.assert_allclose(wrap_angle(ego_b.yaws - ego_a.yaws + turn), 0, atol=1e-9)


def _turned(drive: RenderedDrive, index: int) -> float:
    poses = [drive.world_from_ego(drive.time_s(k)) for k in (index, index + 1)]
    return float(abs(wrap_angle(poses[1].yaw - poses[0].yaw)))


@pytest.mark.slow
def test_ego_motion_is_plausible_for_a_car(assets: Assets):
    """For several seeds: accelerations below 4 m/s², and velocities that agree with the poses."""
    for seed in (3, 8):
        motion = RenderedDrive(seed, frames=20, assets=assets).ego_motion(20.0)
        assert np.hypot(*motion.accelerations[:, :2].T).max() < 4.0
        seconds = np.diff(motion.timestamps_ns) / 1e9
        moved = np.diff(motion.translations, axis=0)
        speeds = np.linalg.norm(moved, axis=1) / seconds
        between = (motion.velocities[1:, 0] + motion.velocities[:-1, 0]) / 2
        np.testing.assert_allclose(speeds, between, atol=0.15)
        assert motion.velocities[:, 0].max() > 1.0


def test_map_agrees_with_the_boxes(drive: RenderedDrive, frame: RenderedFrame):
    """The middle of every vehicle's box is a vehicle cell; moving and parked vehicles are on road cells."""
    bev_map = frame.bev_map
    (x0, half), (_, y1), (cells, _) = bev_map.x_range_m, bev_map.y_range_m, bev_map.cells.shape
    bev = frame.boxes.transformed(inverse(frame.world_from_ego.matrix @ drive.rig.ego_from_bev))
    near = (np.abs(bev.centers[:, :2]) < half - 1).all(axis=1)
    vehicles = near & np.isin(bev.classes, ("car", "truck", "bus", "trailer", "motorcycle", "bicycle"))
    assert vehicles.sum() > 5
    for row in np.nonzero(vehicles)[0]:
        x, y, _ = bev.centers[row]
        column, line = int((x - x0) / (half - x0) * cells), int((y1 - y) / (y1 + half) * cells)
        cell = bev_map.cells[line, column]
        assert cell & 8
        if bev.instances[row].startswith(("moving", "parked")):
            assert cell & 1


def test_true_lines_agree_with_the_map(frame: RenderedFrame):
    """Dividers lie on lane boundaries, road boundaries at the edge of the road, all inside the area."""
    bev_map = frame.bev_map
    (rows, columns), (x0, x1), (y0, y1) = bev_map.cells.shape, bev_map.x_range_m, bev_map.y_range_m
    kernel = np.ones((3, 3), np.uint8)
    road = bev_map.layer("drivable_road").astype(np.uint8)
    layers = {
        "divider": cv2.dilate(bev_map.layer("lane_boundary").astype(np.uint8), kernel),
        "boundary": cv2.dilate(road, kernel) & (1 - cv2.erode(road, kernel)),
        "ped_crossing": cv2.dilate(bev_map.layer("pedestrian_crossing").astype(np.uint8), kernel),
    }
    assert set(frame.lines.classes) >= {"divider", "boundary"}
    for name, points in zip(frame.lines.classes, frame.lines.points, strict=True):
        assert (np.abs(points) <= (15.001, 30.001)).all()
        column = ((points[:, 0] - x0) / (x1 - x0) * columns).astype(int)
        row = ((y1 - points[:, 1]) / (y1 - y0) * rows).astype(int)
        assert layers[str(name)][row, column].mean() > 0.9, name


def test_boxes_are_near_unique_and_have_valid_visibilities(drive: RenderedDrive, frame: RenderedFrame):
    boxes = frame.boxes
    origin = (frame.world_from_ego.matrix @ drive.rig.ego_from_bev)[:2, 3]
    assert np.hypot(*(boxes.centers[:, :2] - origin).T).max() < ANNOTATED_M
    assert set(boxes.classes) <= set(NUSCENES_CLASSES)
    assert len(set(boxes.instances)) == len(boxes)
    assert ((boxes.visibilities >= 0) & (boxes.visibilities <= 1)).all()
    np.testing.assert_array_equal(boxes.num_points > 0, boxes.visibilities > 0)


def test_boxes_contain_their_pixels_with_lens_distortion(drive: RenderedDrive, frame: RenderedFrame):
    lens = Distortion("brown_conrady", (-0.25, 0.08, 0.001, -0.0005))
    rig = CameraRig((replace(drive.rig["CAM_BACK"], distortion=lens),), drive.rig.ego_from_bev)
    bent = with_rig(drive, rig)
    view, states = bent.frame(9).views["CAM_BACK"], [state for _, state in bent._actors(9)]
    camera, checked = rig["CAM_BACK"], 0
    for index in np.unique(view.objects[view.objects >= 0]):
        row = np.nonzero(frame.boxes.instances == states[index].body.instance)[0]
        if not len(row):
            continue
        corners = frame.boxes[row].transformed(inverse(frame.world_from_ego.matrix)).corners()[0]
        pixels, depth = camera.project_ego(corners)
        if depth.min() < 1 or not np.isfinite(pixels).all():
            continue
        v, u = np.nonzero(view.objects == index)
        assert u.min() > pixels[:, 0].min() - 1.5
        assert u.max() < pixels[:, 0].max() + 1.5
        assert v.min() > pixels[:, 1].min() - 1.5
        checked += 1
    assert checked > 5


@pytest.mark.slow
def test_drives_are_dense(assets: Assets):
    """Eight drives, every fourth frame: at least 15 boxes within 32 m, 15 % of them barely visible, all classes."""
    counts, near, hidden, frames = dict.fromkeys(NUSCENES_CLASSES, 0), 0, 0, 0
    for seed in range(200, 208):
        drive = RenderedDrive(seed, frames=20, rig=nuscenes_like_rig(200, 112), assets=assets)
        for index in range(0, 20, 4):
            frame = drive.frame(index)
            for name in frame.boxes.classes:
                counts[str(name)] += 1
            origin = (frame.world_from_ego.matrix @ drive.rig.ego_from_bev)[:2, 3]
            inside = np.hypot(*(frame.boxes.centers[:, :2] - origin).T) < 32
            near += int(inside.sum())
            hidden += int((frame.boxes.visibilities[inside] < 0.4).sum())
            frames += 1
    assert near / frames >= 15
    assert hidden / near >= 0.15
    assert all(count >= 200 * frames / 800 for count in counts.values()), counts


@pytest.mark.slow
def test_vehicles_do_not_drive_through_each_other(assets: Assets):
    for seed in range(300, 306):
        drive = RenderedDrive(seed, frames=20, assets=assets)
        for index in range(0, 20, 3):
            states = [s for s in [state for _, state in drive._actors(index)] if s.body.instance.startswith("moving")]
            for i, one in enumerate(states):
                for other in states[i + 1 :]:
                    if one.body.instance.split("-")[1] == other.body.instance.split("-")[1]:
                        continue  # a tractor and its trailer touch
                    assert not _overlap(one, other), (seed, index, one.body.instance, other.body.instance)


def _overlap(one: ActorState, other: ActorState, tolerance_m: float = 0.15) -> bool:
    """Whether two boxes that are smaller by a tolerance overlap on the ground."""
    outlines = []
    for state in (one, other):
        length, width = state.body.size_lwh[:2] / 2 - tolerance_m / 2
        local = np.array([(length, width), (-length, width), (-length, -width), (length, -width)])
        c, s = np.cos(state.yaw), np.sin(state.yaw)
        outlines.append(Polygon(local @ np.array([[c, s], [-s, c]]) + state.position[:2]))
    return outlines[0].intersects(outlines[1])
