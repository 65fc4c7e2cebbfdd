"""Camera views are ordered by yaw; labels do not overlap."""

import numpy as np
from memory_drive import make_rig

from bevcli.recording.blueprint import camera_rows, rows_by_yaw
from bevcli.recording.box_lines import LETTER_HEIGHT, LETTER_WIDTH, ImageLines, labels_in_image


def test_nuscenes_cameras_are_in_two_rows():
    assert camera_rows(make_rig()) == (
        ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT"),
        ("CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT"),
    )


def test_other_rigs_are_ordered_by_yaw():
    yaws = {"left": 90, "rear": 180, "ahead": 0, "right": -90, "rear_right": -150, "rear_left": 150}
    rows = rows_by_yaw({name: np.radians(yaw) for name, yaw in yaws.items()})
    assert rows == (("left", "ahead", "right"), ("rear_left", "rear", "rear_right"))


def test_a_single_camera_has_one_row():
    assert camera_rows(make_rig({"only": 10})) == (("only",),)
    assert camera_rows(make_rig({"only": 180})) == (("only",),)


def test_labels_do_not_overlap_and_the_largest_box_wins():
    boxes = np.array([[100, 100, 30], [110, 100, 90], [500, 100, 60], [600, 300, 2]])  # x, y, height
    segments = np.array([[[x, y], [x + 5, y + h]] for x, y, h in boxes], dtype=float)
    centers, owners = labels_in_image(ImageLines(segments, np.arange(4)), ["car 0.50"] * 4, 800, 450)
    assert owners.tolist() == [1, 2]  # the first is covered by the second, the last is too small
    size = np.array([8 * LETTER_WIDTH * 800, LETTER_HEIGHT * 450])
    assert (np.abs(centers[0] - centers[1]) >= size - 1e-9).any()
    assert (centers - size / 2)[:, 0].min() >= -1e-9
