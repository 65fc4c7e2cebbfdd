"""Boxes where no camera looks: marked by the geometry of the frame's images, and left out of what is shown."""

from dataclasses import replace

import numpy as np
from memory_drive import MemoryDrive, make_rig
from stepping import run

from bevcli.geometry.boxes import Boxes3D
from bevcli.recording.log_cameras import box_labels

FRONT = make_rig({"CAM_FRONT": 0})  # at x 0.9 m, z 1.6 m; it sees 5 / 8 of the depth to each side, 9 / 25 up and down


def at(*places_ego: tuple[float, float, float]) -> Boxes3D:
    """Boxes 4 m long, 2 m wide and 1.5 m high, in the ego frame."""
    count = len(places_ego)
    sizes, yaws, velocities = np.tile([4.0, 2.0, 1.5], (count, 1)), np.zeros(count), np.zeros((count, 2))
    return Boxes3D(np.array(places_ego), sizes, yaws, velocities, np.array(["car"] * count))


def test_a_frame_sees_boxes_by_their_vertical_axes():
    frame = MemoryDrive(2, rig=FRONT).load(1)
    boxes = at((10.9, 6.2, 1), (10.9, 6.3, 1), (-9.1, 0, 1), (1.9, 0, 0.75), (1.9, 0, 0.4), (10.9, -6.2, 1))
    in_world = boxes.transformed(frame.world_from_ego.matrix)
    # 1 m before the camera it sees from 1.24 m up: a box from 0 to 1.5 m reaches there, one up to 1.15 m does not.
    assert frame.sees(in_world).tolist() == [True, False, False, True, False, True]
    assert not replace(frame, images={}).sees(in_world).any()


def test_a_run_marks_what_no_camera_sees(mini_model):
    drive = MemoryDrive(2, rig=FRONT)
    (default, _), (every, _) = (run(mini_model, drive, track=False, unseen=unseen) for unseen in (False, True))
    for marked, plain in zip(default, every, strict=True):
        x, y, _ = (marked.boxes_ego.centers - (0.9, 0, 0)).T
        assert marked.boxes.unseen.any()
        assert (marked.boxes.unseen | ((x > 0) & (np.abs(y) < x * 5 / 8))).all()
        assert len(marked.boxes.shown(0)) == (~marked.boxes.unseen).sum()
        assert plain.boxes.unseen is None
        assert len(plain.boxes.shown(0)) == len(plain.boxes) == len(marked.boxes)
        assert np.array_equal(plain.boxes.scores, marked.boxes.scores)


def test_the_label_of_a_carried_box_says_so():
    boxes = replace(at((9, 0, 1), (9, 4, 1)), scores=np.array([0.5, 0.4]), instances=np.array(["3", ""]))
    assert box_labels(replace(boxes, unseen=np.array([True, False]))) == ["car #3 0.50 out of view", "car 0.40"]
