"""The programs of docs/live.md, run against stand-ins for cameras, ROS 2 and CARLA."""

import inspect
import re
import sys
import threading
import time
from collections import namedtuple
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from memory_drive import MemoryDrive, make_rig

import bevcli
from bevcli.geometry.object_classes import SHOWN_SCORE
from bevcli.geometry.transforms import rigid, rotation_about_z

PAGE = (Path(__file__).parents[2] / "docs/live.md").read_text()
PROGRAMS = dict(re.findall(r"^`(\w+)\.py`:\n\n```python\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL))
CAMERAS = ("CAM_FRONT", "CAM_BACK")


def program(name: str) -> SimpleNamespace:
    """A program of the page, imported."""
    found: dict[str, object] = {"__name__": name}
    exec(compile(PROGRAMS[name], f"{name}.py", "exec"), found)
    return SimpleNamespace(**found)


@pytest.fixture(scope="module")
def model(mini_model):
    return bevcli.Model(mini_model)


@pytest.fixture
def rig():
    return make_rig({"CAM_FRONT": 0.0, "CAM_BACK": 180.0})


def wait_until(condition):
    end = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


class Stream:
    """Stands in for cv2.VideoCapture: the images of one source, until the stream breaks off."""

    opened: ClassVar = []
    over = False

    def __init__(self, source):
        self.opened.append(source)
        self.left = 10**9 if source == 0 else 3 * (self.opened.count(source) == 1)

    def read(self):
        if Stream.over:
            threading.Event().wait()
        time.sleep(0.001)
        self.left -= 1
        return (True, np.full((180, 320, 3), 40, np.uint8)) if self.left >= 0 else (False, None)

    def release(self):
        pass


def test_streams_give_the_newest_images(model, rig):
    cameras = program("cameras")
    contents = cameras.live.__globals__
    contents["cv2"] = SimpleNamespace(VideoCapture=Stream)
    contents["OLDEST_S"] = 60.0  # however long the session takes to begin
    threads = {name: cameras.NewestImage(source) for name, source in zip(CAMERAS, ("0", "rtsp://back"), strict=True)}
    wait_until(lambda: all(thread.shot for thread in threads.values()))
    session = bevcli.Session(model, rig)
    steps = cameras.live(session, threads, rate_hz=100)
    _, delay_s = next(steps)
    assert session.frame.images.keys() == set(CAMERAS)
    assert delay_s > 0
    assert 0 in Stream.opened
    next(steps)  # the first one loads code, which may take longer than the largest gap
    contents["OLDEST_S"] = 0.1
    time.sleep(0.15)  # of the stream that broke off, the last image is now too old
    prediction, _ = next(steps)
    assert session.frame.images.keys() == {"CAM_FRONT"}
    assert prediction.started_anew is None
    Stream.over = True


class Message(SimpleNamespace):
    """A ROS message: a field that was not set is a message itself."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, [] if name in ("results", "detections") else Message())
        return getattr(self, name)


class FakeNode:
    """Stands in for rclpy's Node, and keeps what it makes."""

    def __init__(self, name):
        self.heard, self.sent, self.timers = {}, [], []

    def create_subscription(self, kind, topic, callback, quality):
        inspect.signature(callback).bind(object())  # as rclpy does
        self.heard[topic] = callback

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.sent.append)

    def create_timer(self, period_s, callback):
        self.timers.append((period_s, callback))


@pytest.fixture
def ros(monkeypatch):
    modules = {
        "rclpy": {}, "rclpy.node": {"Node": FakeNode}, "rclpy.qos": {"qos_profile_sensor_data": 10},
        "nav_msgs": {}, "nav_msgs.msg": {"Odometry": Message},
        "sensor_msgs": {}, "sensor_msgs.msg": {"CameraInfo": Message, "Image": Message},
        "vision_msgs": {},
        "vision_msgs.msg": dict.fromkeys(("Detection3D", "Detection3DArray", "ObjectHypothesisWithPose"), Message),
    }  # fmt: skip
    for name, contents in modules.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)


def header(time_ns, frame_id="odom"):
    seconds, rest = divmod(time_ns, 10**9)
    return Message(stamp=Message(sec=seconds, nanosec=rest), frame_id=frame_id)


def odometry(time_ns, pose):
    (x, y, z), (qw, qx, qy, qz) = pose.translation, pose.quaternion
    turned = Message(position=Message(x=x, y=y, z=z), orientation=Message(w=qw, x=qx, y=qy, z=qz))
    return Message(header=header(time_ns), pose=Message(pose=turned))


def image_message(image, encoding):
    pixels = image.pixels_bgr if encoding == "bgr8" else image.pixels_bgr[..., ::-1]
    padded = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, 8)))  # rows may be longer than their pixels
    return Message(
        header=header(image.timestamp_ns), height=180, width=320, step=968, encoding=encoding, data=padded.tobytes()
    )


def test_the_node_publishes_the_boxes_of_a_session(model, rig, ros):
    page = program("bevcli_node")
    drive, session = MemoryDrive(3, rig), bevcli.Session(model, rig)
    node = page.BevcliNode(model, rig, {"CAM_FRONT": "/front", "CAM_BACK": "/back"})
    [(period_s, step)] = node.timers
    assert period_s == 0.5
    step()  # before any message
    for camera, topic in zip(rig.cameras, ("/front", "/back"), strict=True):
        info = Message(width=320, height=180, k=camera.intrinsics.ravel(), d=[0.0] * 5, distortion_model="plumb_bob")
        node.heard[f"{topic}/camera_info"](info)
    for place in range(3):
        frame = drive.load(place)
        node.heard["/odometry"](odometry(frame.stamp.timestamp_ns, frame.world_from_ego))
        node.heard["/front/image_raw"](image_message(frame.images["CAM_FRONT"], "bgr8"))
        if place != 1:  # lost: the older image is left out
            node.heard["/back/image_raw"](image_message(frame.images["CAM_BACK"], "rgb8"))
        step()
        step()  # no new image, no new boxes
        images = {name: one.pixels_bgr for name, one in frame.images.items() if place != 1 or name == "CAM_FRONT"}
        expected = session.step(images, frame.world_from_ego, frame.stamp.timestamp_ns)
    assert len(node.sent) == 3
    found = page.detections(expected, "odom", least=0)
    boxes = expected.boxes_world
    assert np.array_equal([one.bbox.center.position.x for one in found.detections], boxes.centers[:, 0])
    assert [one.results[0].hypothesis.class_id for one in found.detections] == boxes.classes.tolist()
    assert node.session.frame.kinematics.velocity == pytest.approx(session.frame.kinematics.velocity)
    assert page.nanoseconds(node.sent[-1].header) == expected.stamp.timestamp_ns
    assert len(node.sent[-1].detections) == len(boxes.scored(SHOWN_SCORE))
    assert sum(map(bool, PROGRAMS["bevcli_node"].splitlines())) <= 88


# CARLA's frames: x forward, y RIGHT, z up; yaw clockwise seen from above.
Transform = namedtuple("Transform", "x y z yaw_deg")


def left_handed(transform):
    turn = rotation_about_z(np.radians(transform.yaw_deg))  # as CARLA's matrix: x to y, which is to the right
    return SimpleNamespace(get_matrix=lambda: rigid(transform[:3], turn).tolist())


class World:
    """A CARLA world with one vehicle that drives along the world's right (y), and its cameras."""

    def __init__(self, lost):
        self.frame, self.lost, self.listeners = 100, lost, []

    def get_blueprint_library(self):
        return SimpleNamespace(find=lambda name: SimpleNamespace(set_attribute=lambda key, value: None))

    def spawn_actor(self, blueprint, transform, attach_to):
        return SimpleNamespace(listen=self.listeners.append)

    def get_transform(self):
        return left_handed(Transform(10.0, 0.3 * (self.frame - 100), 0, 90.0))

    def get_snapshot(self):
        return SimpleNamespace(timestamp=SimpleNamespace(elapsed_seconds=0.05 * self.frame))

    def tick(self):
        self.frame += 1
        for place, listener in enumerate(self.listeners):
            number = self.frame - 1 if (self.frame, place) in self.lost else self.frame
            listener(SimpleNamespace(frame=number, raw_data=np.full((450, 800, 4), self.frame, np.uint8).tobytes()))
        return self.frame


def test_carla_frames_reach_the_session_right_handed(model):
    page, world = program("carla_client"), World({(111, 1)})
    places = {name: left_handed(Transform(0.5, 0, 1.7, yaw)) for name, yaw in page.YAWS_DEG.items()}
    client = page.Client(model, world, world, places)
    yaws = {camera.name: np.degrees(camera.yaw) for camera in client.session.rig.cameras}
    assert yaws["CAM_FRONT_LEFT"] == pytest.approx(55)
    assert yaws["CAM_BACK_RIGHT"] == pytest.approx(-110)
    front = client.session.rig["CAM_FRONT"]
    np.testing.assert_allclose(front.project_ego([10.0, 1.0, 1.7])[0], [399.5 - 571.26 / 8.1, 224.5], atol=0.01)
    predictions = [client.tick(wait_s=0.05) for _ in range(11)]
    assert [place for place, one in enumerate(predictions) if one is not None] == [0, 10]
    frame = client.session.frame
    assert frame.dropped.keys() == {"CAM_FRONT_RIGHT"}
    assert frame.images["CAM_BACK"].pixels_bgr.shape == (450, 800, 3)
    assert frame.world_from_ego.yaw == pytest.approx(-np.pi / 2)
    np.testing.assert_allclose(frame.world_from_ego.translation, [10, -3.3 + 1.4, 0], atol=1e-9)
    np.testing.assert_allclose(frame.kinematics.velocity, [6, 0, 0], atol=1e-6)
