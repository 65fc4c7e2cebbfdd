"""Box lines in an image: clipped near the camera and at the border, curved by distortion."""

from dataclasses import replace

import cv2
import numpy as np
from made_boxes import made_boxes

from bevcli.geometry.boxes import BOX_EDGES, Boxes3D
from bevcli.geometry.cameras import Camera, Distortion
from bevcli.recording.log_cameras import NEAR_CLIP_M, PosedCamera, clip_near, clip_to_image, lines_in_images

FINE = 256  # cv2.clipLine takes integers: subdivide the pixels
CAMERA = Camera("front", 640, 360, np.array([[400.0, 0, 320], [0, 400, 180], [0, 0, 1]]), np.eye(4))
AT_ORIGIN = PosedCamera(CAMERA, np.eye(4), np.eye(4))


def one_box(center, size=(2.0, 2.0, 2.0)) -> Boxes3D:
    """In the camera frame: z is ahead."""
    return made_boxes([center], sizes_lwh=size)


def test_lines_are_clipped_as_by_opencv():
    random = np.random.default_rng(1)
    segments = random.integers(-400, 1000, (400, 2, 2)).astype(float)
    clipped, kept = clip_to_image(segments, 640, 360)
    for segment, ours, is_kept in zip(segments, clipped, kept, strict=True):
        start, end = (segment * FINE).astype(int).tolist()
        inside, start, end = cv2.clipLine((0, 0, 640 * FINE + 1, 360 * FINE + 1), start, end)
        if not inside:
            assert not is_kept or np.linalg.norm(ours[0] - ours[1]) < 0.1
        elif np.linalg.norm(np.subtract(start, end)) > FINE / 10:
            assert is_kept
            np.testing.assert_allclose(ours, np.array([start, end]) / FINE, atol=0.1)


def test_a_line_through_the_camera_is_cut_at_the_near_plane():
    ends, before = clip_near(np.array([[[0.0, 0, -1], [0, 0, 3]], [[0, 0, -1], [0, 0, -2]]]))
    assert before.tolist() == [True, False]
    np.testing.assert_allclose(ends[0], [[0, 0, NEAR_CLIP_M], [0, 0, 3]])


def test_a_box_around_the_camera_stays_inside_the_image():
    lines = lines_in_images(one_box((2, 0, 0), (6, 6, 6)).corners(), [AT_ORIGIN])[0]
    assert len(lines.segments)
    assert lines.segments.min() >= -1e-9
    assert (lines.segments <= [640 + 1e-9, 360 + 1e-9]).all()
    assert not len(lines_in_images(one_box((0, 0, -10)).corners(), [AT_ORIGIN])[0].segments)  # behind the camera


def test_a_box_ahead_is_where_the_pinhole_model_projects_it():
    lines = lines_in_images(one_box((0, 0, 10)).corners(), [AT_ORIGIN])[0]
    # Its nearest face is 9 m away and 2 m wide: 400 px/m at 1 m, 44.4 px at 9 m to each side.
    np.testing.assert_allclose(lines.segments.reshape(-1, 2).max(0), [320 + 400 / 9, 180 + 400 / 9])
    assert set(lines.owners) == {0}


def test_every_box_of_which_an_edge_is_inside_the_image_is_drawn():
    random = np.random.default_rng(0)
    count = 400
    sizes, yaws = random.uniform(0.5, 12, (count, 3)), random.uniform(-np.pi, np.pi, count)
    boxes = Boxes3D(random.normal(size=(count, 3)) * 12, sizes, yaws, np.zeros((count, 2)), np.array(["car"] * count))
    (lines,) = lines_in_images(boxes.corners(), [AT_ORIGIN])
    shares = np.linspace(0, 1, 200)[:, None]
    expected = set()
    for index, corners in enumerate(boxes.corners()):
        for start, end in BOX_EDGES:
            x, y, z = (corners[start] + shares * (corners[end] - corners[start])).T
            ahead = z > NEAR_CLIP_M
            u, v = 320 + 400 * x[ahead] / z[ahead], 180 + 400 * y[ahead] / z[ahead]
            if ((u > 0) & (u < 640) & (v > 0) & (v < 360)).any():
                expected.add(index)
    assert 50 < len(expected) < 350
    assert expected <= set(lines.owners)


def test_a_distorted_edge_is_curved():
    lens = Distortion("brown_conrady", (-0.3, 0.05, 0.0, 0.0))
    box = one_box((0, 2.2, 8), (7.0, 0.5, 0.5))
    lines = lines_in_images(box.corners(), [replace(AT_ORIGIN, camera=replace(CAMERA, distortion=lens))])[0]
    corners = box.corners()[0, :4]
    middle = (corners[0] + corners[1]) / 2
    numbers = CAMERA.intrinsics, np.array(lens.coefficients)
    expected, _ = cv2.projectPoints(middle[None], np.zeros(3), np.zeros(3), *numbers)
    away = np.linalg.norm(lines.segments.reshape(-1, 2) - expected.reshape(2), axis=-1).min()
    straight = np.array([CAMERA.project(c)[0] for c in corners[:2]]).mean(0)
    assert away < 1.5
    assert np.linalg.norm(straight - expected.reshape(2)) > 3
