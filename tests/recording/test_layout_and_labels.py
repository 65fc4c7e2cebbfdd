"""Camera views are ordered by yaw; labels do not overlap."""

import numpy as np
import pytest
from memory_drive import MemoryDrive, make_camera, make_rig
from recorded_drive import record

from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, CameraRig, default_ego_from_bev
from bevcli.recording import entities
from bevcli.recording.blueprint import TEXTS_SHARE, TITLE_HEIGHT, WINDOW, camera_row_shares, camera_rows, rows_by_yaw
from bevcli.recording.log_cameras import LETTER_HEIGHT, LETTER_WIDTH, ImageLines, labels_in_image
from bevcli.viewer.recording_reader import RecordingReader


def test_cameras_are_in_rows_by_yaw():
    assert camera_rows(make_rig()) == (
        ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT"),
        ("CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT"),
    )
    assert camera_rows(make_rig({"only": 180})) == camera_rows(make_rig({"only": 10})) == (("only",),)
    yaws = {"left": 90, "rear": 180, "ahead": 0, "right": -90, "rear_right": -150, "rear_left": 150}
    rows = rows_by_yaw({name: np.radians(yaw) for name, yaw in yaws.items()})
    assert rows == (("left", "ahead", "right"), ("rear_left", "rear", "rear_right"))


FOUR = {"front": 0, "left": 90, "right": -90, "rear": 180}
RIGS = {
    "one": {"front": 0},
    "two": {"front": 0, "rear": 180},
    "three": {"left": 60, "right": -60, "rear": 180},
    "four": FOUR,
    "five": {"front": 0, "front_left": 55, "front_right": -55, "rear_left": 120, "rear_right": -120},
    "six": NUSCENES_YAWS_DEG,
    "seven": {**NUSCENES_YAWS_DEG, "tele": 1},
    "eight": {**FOUR, "front_left": 45, "front_right": -45, "rear_left": 135, "rear_right": -135},
}


def image_sizes(rig):
    """The width and height of each image in its view in the viewer's window, pixels."""
    sizes = {}
    for row, share in zip(camera_rows(rig), camera_row_shares(rig), strict=True):
        view = WINDOW[0] * (1 - TEXTS_SHARE) / len(row), share * WINDOW[1] - TITLE_HEIGHT
        for name in row:
            scale = min(view[0] / rig[name].width, view[1] / rig[name].height)
            sizes[name] = scale * rig[name].width, scale * rig[name].height
    return sizes


@pytest.mark.parametrize("rig", RIGS)
def test_all_images_of_a_rig_are_equally_large(rig):
    sizes = np.array(list(image_sizes(make_rig(RIGS[rig])).values()))
    assert sizes.min(axis=0) == pytest.approx(sizes.max(axis=0))
    assert 0.1 < sum(camera_row_shares(make_rig(RIGS[rig]))) < 0.7  # the middle keeps room
    assert sizes[0, 0] > 0.98 * min(WINDOW[0] * (1 - TEXTS_SHARE) / max(map(len, rows_by_yaw(RIGS[rig]))), 480)


def test_a_single_rear_camera_does_not_squeeze_the_others():
    sizes = image_sizes(make_rig(FOUR))
    assert min(height for _, height in sizes.values()) > 0.25 * WINDOW[1]
    assert sum(camera_row_shares(make_rig(FOUR))) < 0.63
    narrow = make_camera("rear", 180, width=180, height=320)
    rig = make_rig({"front": 0, "left": 60, "right": -60})
    sizes = image_sizes(CameraRig((*rig.cameras, narrow), rig.ego_from_bev))
    assert sizes["front"][1] > 0.2 * WINDOW[1]
    assert 0.25 * WINDOW[1] < sizes["rear"][1] < 0.63 * WINDOW[1]


def test_few_or_square_images_share_one_row():
    assert camera_rows(make_rig(RIGS["two"])) == (("front", "rear"),)
    assert camera_rows(make_rig(RIGS["three"])) == (("left", "right", "rear"),)
    square = tuple(make_camera(name, yaw, width=320, height=320) for name, yaw in FOUR.items())
    assert camera_rows(CameraRig(square, default_ego_from_bev())) == (("left", "front", "right", "rear"),)


def test_labels_do_not_overlap_and_the_largest_box_wins():
    boxes = np.array([[100, 100, 30], [110, 100, 90], [500, 100, 60], [600, 300, 2]])  # x, y, height
    segments = np.array([[[x, y], [x + 5, y + h]] for x, y, h in boxes], dtype=float)
    centers, owners = labels_in_image(ImageLines(segments, np.arange(4)), ["car 0.50"] * 4, 800, 450)
    assert owners.tolist() == [1, 2]  # the first is covered by the second, the last is too small
    size = np.array([8 * LETTER_WIDTH * 800, LETTER_HEIGHT * 450])
    assert (np.abs(centers[0] - centers[1]) >= size - 1e-9).any()
    assert (centers - size / 2)[:, 0].min() >= -1e-9


def test_the_labels_of_the_legend_begin_at_their_colours(tmp_path):
    """Letters are at most 0.3 units wide."""
    record(tmp_path / "r.rrd", MemoryDrive(1))
    (frame,) = RecordingReader(tmp_path / "r.rrd").frames()
    colors, texts = (frame.array(f"{entities.LEGEND}/{kind}", "Points2D:positions", 2) for kind in ("colors", "texts"))
    halves = np.array([len(text) for text in frame.texts(f"{entities.LEGEND}/texts", "Points2D:labels")]) * 0.15
    starts = texts[:, 0] - halves - colors[:, 0]
    assert len(starts) > 10
    assert (starts > -0.1).all()
    assert (starts < 1.0).all()
