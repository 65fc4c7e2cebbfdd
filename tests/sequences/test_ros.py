"""Bags written with the packages of ROS and MCAP, read as sequences."""

import base64
import contextlib
import json
import shutil
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import cycle
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import (
    Message,
    camera_info,
    drive_messages,
    header,
    odometry,
    transform,
    write_encoded,
    write_json_mcap,
    write_mcap,
    write_protobuf_mcap,
    write_rosbag2,
    xyz,
)

from bevcli.errors import InputError
from bevcli.frame import CameraImage, Drive, Frame
from bevcli.geometry.cameras import Distortion
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.sequences.open import open_sequence


@pytest.fixture(scope="module", autouse=True)
def message_types_compiled_once() -> Iterator[None]:
    """rosbags compiles the code that reads a type of messages anew for each bag."""
    from rosbags.serde import cdr

    compiled = cache(lambda text, compile_lines=cdr.compile_lines: compile_lines([text]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cdr, "compile_lines", lambda lines: compiled("\n".join(lines)))
        yield


@pytest.fixture
def native(drive: Path) -> Drive:
    """The small drive as the native folder that the bags are written from."""
    return open_sequence(drive)


@pytest.fixture
def motion(drive: Path) -> EgoMotion:
    """The ego-motion of the small drive."""
    return read_ego_motion(drive / "ego_motion.csv")


def messages_of(native: Drive, motion: EgoMotion | None, **options) -> list[Message]:
    return list(drive_messages(native, motion, **options))


def with_info(messages: list[Message], info: dict) -> list[Message]:
    """The messages with another CameraInfo of the front camera."""
    return [(t, kind, time, info if t == "/CAM_FRONT/camera_info" else f) for t, kind, time, f in messages]


def assert_posed(found: Frame, true: Frame, name: str = "CAM_FRONT", atol: float = 1e-9) -> None:
    """The camera has the same pose in both frames."""
    poses = (frame.world_from_ego_at[name].matrix for frame in (found, true))
    np.testing.assert_allclose(*poses, atol=atol)


def write(folder: Path, form: str, messages: list[Message]) -> Path:
    if form == "mcap":
        return write_mcap(folder / "bag.mcap", messages)
    return write_rosbag2(folder / "bag", messages, form.removeprefix("rosbag2 "))


@pytest.mark.parametrize("form", ["mcap", "rosbag2 sqlite3", "rosbag2 mcap"])
@pytest.mark.parametrize("poses_in", ["odometry", "tf"])
def test_a_bag_gives_the_frames_it_was_written_from(tmp_path, native, motion, form, poses_in):
    sequence = open_sequence(write(tmp_path, form, messages_of(native, motion, poses_in=poses_in)))
    assert set(sequence.rig.names) == set(native.rig.names)
    for camera in native.rig.cameras:
        np.testing.assert_allclose(sequence.rig[camera.name].ego_from_camera, camera.ego_from_camera, atol=1e-12)
        np.testing.assert_array_equal(sequence.rig[camera.name].intrinsics, camera.intrinsics)
    assert len(sequence.stamps) == len(native.stamps)
    for place in range(len(native.stamps)):
        found, true = sequence.load(place), native.load(place)
        assert not found.dropped
        for name, image in true.images.items():
            assert found.images[name].timestamp_ns == image.timestamp_ns
            np.testing.assert_array_equal(found.images[name].pixels_bgr, image.pixels_bgr)
            assert_posed(found, true, name)
        np.testing.assert_allclose(found.kinematics.velocity, [10, 0, 0], atol=1e-6)


def test_the_time_of_an_image_is_stated_not_that_of_recording(tmp_path, native, motion):
    path = write_mcap(tmp_path / "bag.mcap", messages_of(native, motion, delay_ns=180_000_000))
    sequence = open_sequence(path)
    times = [stamp.timestamp_ns for stamp in sequence.stamps]
    assert times == [native.load(place).images["CAM_BACK"].timestamp_ns for place in range(4)]
    assert sequence.load(0).images["CAM_FRONT"].timestamp_ns == native.stamps[0].timestamp_ns
    # A bag that was recorded anew from a replay has delays that change.
    messages = [(t, kind, time + 3 * (time - 10**9), fields) for t, kind, time, fields in messages_of(native, motion)]
    sequence = open_sequence(write_mcap(tmp_path / "bag.mcap", messages))
    assert sequence.stamps[3].timestamp_ns == native.load(3).images["CAM_BACK"].timestamp_ns
    assert_posed(sequence.load(2), native.load(2))


def test_opening_a_large_bag_reads_few_images(tmp_path, native, motion, monkeypatch):
    from bevcli.workshop.formats.ros.storage import McapFile

    monkeypatch.setattr("bevcli.workshop.formats.ros.vehicle.READ_WHOLE", 0)
    messages = messages_of(native, motion)
    images = [message for message in messages if "image" in message[0]]
    for repeat in range(1, 50):
        shift = repeat * 2 * 10**9
        messages += [(t, k, time + shift, {**f, "header": header(time + shift, "")}) for t, k, time, f in images]
    path = write_mcap(tmp_path / "bag.mcap", messages, chunk_size=2_000)
    read: list[int] = []
    chunk_of = McapFile._chunk

    def counted(self: McapFile, position: int) -> bytes:
        read.append(position)
        return chunk_of(self, position)

    monkeypatch.setattr(McapFile, "_chunk", counted)
    sequence = open_sequence(path, ego_motion="static")
    assert len(sequence.stamps) == 200
    assert len(set(read)) < 20


def test_of_chunks_without_compression_messages_are_read(tmp_path, native, motion, monkeypatch):
    from bevcli.workshop.formats.ros.storage import McapFile

    packed = open_sequence(write_mcap(tmp_path / "packed.mcap", messages_of(native, motion))).load(1)
    monkeypatch.setattr(McapFile, "_chunk", None)
    path = write_mcap(tmp_path / "plain.mcap", messages_of(native, motion), chunk_size=5_000, packed=False)
    plain = open_sequence(path).load(1)
    for name, image in packed.images.items():
        np.testing.assert_array_equal(plain.images[name].pixels_bgr, image.pixels_bgr)
        np.testing.assert_array_equal(plain.world_from_ego_at[name].matrix, packed.world_from_ego_at[name].matrix)


@pytest.mark.parametrize("share", [0.5, 0.8, 0.999])
def test_a_bag_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path, native, motion, share):
    path = write_mcap(tmp_path / "bag.mcap", messages_of(native, motion), chunk_size=1_000)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    sequence = open_sequence(path)
    assert 1 <= len(sequence.stamps) <= 4
    np.testing.assert_array_equal(
        sequence.load(0).images["CAM_FRONT"].pixels_bgr, native.load(0).images["CAM_FRONT"].pixels_bgr
    )
    if share < 0.6:  # of this small file, the index at its end is the rest
        assert any("is cut off" in note for note in sequence.notes)


def test_a_file_without_a_message_says_which_topics_it_has(tmp_path, native, motion):
    others = [("/chatter", "std_msgs/String", 1, {"data": "hello"})]
    path = write_mcap(tmp_path / "bag.mcap", others)
    with pytest.raises(InputError, match=r"has no image topic \(topics: /chatter \(std_msgs/String\)\)"):
        open_sequence(path)
    path.write_bytes(b"something else")
    with pytest.raises(InputError, match="is not an MCAP file"):
        open_sequence(path)


def test_missing_poses_and_extrinsics_are_named(tmp_path, native, motion):
    path = write_mcap(tmp_path / "bag.mcap", messages_of(native, None))
    with pytest.raises(InputError, match=r"has no poses of the vehicle.*/tf_static.*`--ego-motion FILE`"):
        open_sequence(path)
    assert open_sequence(path, ego_motion="static").load(0).images
    messages = [message for message in messages_of(native, motion) if message[0] != "/tf_static"]
    path = write_mcap(tmp_path / "bag.mcap", messages)
    with pytest.raises(
        InputError, match='no transform leads from its frame "CAM_BACK_optical" to "base_link"'
    ) as found:
        open_sequence(path)
    assert "/odom (nav_msgs/Odometry)" in str(found.value)
    poses = [odometry(time, "map", "base_link", NO_POSES["NaN"]) for time in motion.timestamps_ns.tolist()]
    odom = [
        ("/odom", "nav_msgs/Odometry", time, f) for time, f in zip(motion.timestamps_ns.tolist(), poses, strict=True)
    ]
    with pytest.raises(InputError, match=r"/odom: has no poses"):
        open_sequence(write_mcap(tmp_path / "bag.mcap", messages_of(native, None) + odom))


NO_POSES = {
    "NaN": Pose(np.full(3, np.nan), np.array([1.0, 0, 0, 0])),
    "infinite": Pose(np.array([0, np.inf, 0]), np.array([1.0, 0, 0, 0])),
    "zero": Pose(np.zeros(3), np.zeros(4)),
    "NaN rotation": Pose(np.zeros(3), np.full(4, np.nan)),
}


@pytest.mark.parametrize("poses_in", ["odometry", "tf"])
def test_poses_that_are_none_are_left_out_with_their_number(tmp_path, native, motion, poses_in):
    messages = messages_of(native, motion, poses_in=poses_in)
    topic = {"odometry": "/odom", "tf": "/tf"}[poses_in]
    of_topic = [place for place, message in enumerate(messages) if message[0] == topic]
    for place, pose in zip((of_topic[0], *of_topic[4:10:4], of_topic[-1]), NO_POSES.values(), strict=True):
        _, kind, time, fields = messages[place]
        fields = odometry(time, "map", "base_link", pose)
        if poses_in == "tf":
            fields = {"transforms": [transform(time, "map", "base_link", pose)]}
        messages[place] = (topic, kind, time, fields)
    sequence = open_sequence(write_mcap(tmp_path / "bag.mcap", messages))
    assert any(f"{topic}: 4 of {len(of_topic)} poses are left out" in note for note in sequence.notes)
    assert_posed(sequence.load(0), native.load(0))


def test_a_broken_message_with_a_pose_is_left_out(tmp_path, native, motion):
    bag = write_rosbag2(tmp_path / "bag", messages_of(native, motion))
    with contextlib.closing(sqlite3.connect(next(bag.glob("*.db3")))) as database, database:
        (number,) = database.execute("SELECT id FROM topics WHERE name = '/odom'").fetchone()
        (row,) = database.execute("SELECT id FROM messages WHERE topic_id = ? LIMIT 1 OFFSET 7", (number,)).fetchone()
        database.execute("UPDATE messages SET data = x'0001' WHERE id = ?", (row,))
    sequence = open_sequence(bag)
    assert any(f"/odom: 1 of {len(motion.timestamps_ns)} poses are left out" in note for note in sequence.notes)
    assert len(sequence.stamps) == 4


def test_a_static_transform_counts_from_where_it_is_valid(tmp_path, native, motion):
    messages = messages_of(native, motion)
    bad = [transform(1, "base_link", f"{name}_optical", NO_POSES["zero"]) for name in native.rig.names]
    early = [("/tf_static", "tf2_msgs/TFMessage", time, {"transforms": bad}) for time in range(1, 300)]
    sequence = open_sequence(write_mcap(tmp_path / "bag.mcap", early + messages))
    np.testing.assert_allclose(
        sequence.rig["CAM_FRONT"].ego_from_camera, native.rig["CAM_FRONT"].ego_from_camera, atol=1e-12
    )
    assert any("/tf_static: 598 of 600 poses are left out" in note for note in sequence.notes)


def test_a_camera_is_calibrated_from_where_its_k_is_set(tmp_path, native, motion):
    messages = messages_of(native, motion)
    for time, zero in enumerate((0.0, np.nan), start=1):
        unset = {**camera_info(native.rig["CAM_FRONT"], time, ""), "k": [zero] * 9}
        messages.append(("/CAM_FRONT/camera_info", "sensor_msgs/CameraInfo", time, unset))
    sequence = open_sequence(write_mcap(tmp_path / "bag.mcap", messages))
    np.testing.assert_array_equal(sequence.rig["CAM_FRONT"].intrinsics, native.rig["CAM_FRONT"].intrinsics)


@pytest.mark.parametrize(("k", "size", "message"), [(0.01, 64, "implausible focal length"), (50, 0, "image size")])
def test_a_camera_that_no_calibration_may_hold_is_refused(tmp_path, native, motion, k, size, message):
    info = camera_info(native.rig["CAM_FRONT"], 10**9, "CAM_FRONT_optical")
    info |= {"width": size, "k": [k, 0.0, 32, 0, 50.0, 18, 0, 0, 1]}
    messages = with_info(messages_of(native, motion), info)
    with pytest.raises(InputError, match=rf"/CAM_FRONT/camera_info.*CAM_FRONT.*{message}"):
        open_sequence(write_mcap(tmp_path / "bag.mcap", messages))


@pytest.mark.parametrize("rectified", [False, True])
def test_the_intrinsics_are_those_of_the_region_of_interest(tmp_path, native, motion, rectified):
    info = camera_info(native.rig["CAM_FRONT"], 10**9, "CAM_FRONT_optical")
    info |= {"width": 200, "height": 100, "k": [80.0, 0, 100, 0, 80, 50, 0, 0, 1], "binning_x": 2, "binning_y": 2}
    info |= {"p": [80.0, 0, 100, 0, 0, 80, 50, 0, 0, 0, 1, 0]}
    info["roi"] = {"x_offset": 40, "y_offset": 10, "width": 128, "height": 64, "do_rectify": False}
    messages = with_info(messages_of(native, motion), info)
    if rectified:
        messages = renamed(messages, {"/CAM_FRONT/image/compressed": "/CAM_FRONT/image_rect/compressed"})
    camera = open_sequence(write_mcap(tmp_path / "bag.mcap", messages)).rig["CAM_FRONT"]
    assert (camera.width, camera.height) == (64, 32)
    # The sensor's pixel (100, 50) is pixel (60, 40) of the region, and every second pixel of it is kept.
    np.testing.assert_array_equal(camera.intrinsics, [[40, 0, 30], [0, 40, 20], [0, 0, 1]])


@pytest.mark.parametrize("topic", ["/CAM_FRONT/image/compressed", "/CAM_BACK/image/compressed", "/odom"])
def test_messages_in_any_order_give_the_same_frames(tmp_path, native, motion, topic):
    messages = messages_of(native, motion)
    times = [time for name, _, time, _ in messages if name == topic]
    shuffled = iter(np.random.default_rng(0).permutation(times).tolist())
    late = [(name, kind, next(shuffled) if name == topic else time, f) for name, kind, time, f in messages]
    found = open_sequence(write_mcap(tmp_path / "late.mcap", late))
    true = open_sequence(write_mcap(tmp_path / "true.mcap", messages))
    assert found.stamps == true.stamps
    for place in range(len(true.stamps)):
        assert not found.load(place).dropped
        for name, image in true.load(place).images.items():
            np.testing.assert_array_equal(found.load(place).images[name].pixels_bgr, image.pixels_bgr)
            assert_posed(found.load(place), true.load(place), name, 0)


def test_files_beside_the_bag_replace_its_calibration_and_poses(tmp_path, drive, native, motion):
    messages = [message for message in messages_of(native, None) if "image" in message[0]]
    path = write_mcap(tmp_path / "bag.mcap", messages)
    given = {"calibration": drive / "calibration.json", "ego_motion_file": drive / "ego_motion.csv"}
    by_option = open_sequence(path, **given)
    assert by_option.rig.names == native.rig.names
    for name in ("calibration.json", "ego_motion.csv"):
        shutil.copy(drive / name, tmp_path)
    sequence = open_sequence(path)
    assert sum("is used in place of" in note for note in sequence.notes) == 2
    assert_posed(sequence.load(1), native.load(1), "CAM_BACK")
    np.testing.assert_array_equal(sequence.rig.ego_from_bev, native.rig.ego_from_bev)


def renamed(messages: list[Message], names: dict[str, str]) -> list[Message]:
    return [(names.get(topic, topic), kind, time, fields) for topic, kind, time, fields in messages]


AUTOWARE = {
    "/CAM_FRONT/image/compressed": "/sensing/camera/camera0/image_rect_color/compressed",
    "/CAM_FRONT/camera_info": "/sensing/camera/camera0/camera_info",
    "/CAM_BACK/image/compressed": "/sensing/camera/camera1/image_rect_color/compressed",
    "/CAM_BACK/camera_info": "/sensing/camera/camera1/camera_info",
    "/odom": "/localization/kinematic_state",
}


def test_autoware_topics_are_found(tmp_path, native, motion):
    messages = renamed(messages_of(native, motion), AUTOWARE)
    pose = {"position": xyz(np.zeros(3)), "orientation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
    wrong = [("/sensing/gnss/pose", "geometry_msgs/PoseStamped", 1, {"header": header(1, "map"), "pose": pose})]
    path = write_mcap(tmp_path / "bag.mcap", messages + wrong)
    sequence = open_sequence(path)
    assert sequence.rig.names == ("camera0", "camera1")
    assert "ego-motion     /localization/kinematic_state" in sequence.notes[0]
    stated = {"CAM_FRONT": AUTOWARE["/CAM_FRONT/image/compressed"]}
    assert set(open_sequence(path, topics=stated).rig.names) == {"CAM_FRONT", "camera1"}


def test_a_topics_file_states_cameras_frames_and_poses(tmp_path, native, motion):
    names = {
        "/CAM_FRONT/image/compressed": "/a/first",
        "/CAM_FRONT/camera_info": "/b/one",
        "/CAM_BACK/image/compressed": "/a/second",
        "/CAM_BACK/camera_info": "/b/two",
    }
    messages = renamed(messages_of(native, motion), names)
    path = write_mcap(tmp_path / "bag.mcap", messages)
    topics = tmp_path / "topics.toml"
    topics.write_text(
        'ego_motion = "/odom"\n[cameras]\nCAM_BACK = "/a/second"\n[calibration]\nCAM_BACK = "/b/two"\n'
        '[frames]\nCAM_BACK = "CAM_BACK_optical"\n'
    )
    sequence = open_sequence(path, topics_file=topics)
    assert sequence.rig.names == ("CAM_BACK",)
    np.testing.assert_allclose(
        sequence.rig["CAM_BACK"].ego_from_camera, native.rig["CAM_BACK"].ego_from_camera, atol=1e-12
    )
    topics.write_text("camera = 1\n")
    with pytest.raises(InputError, match=r'topics\.toml: unknown key "camera"'):
        open_sequence(path, topics_file=topics)
    with pytest.raises(InputError, match="has no topic /nothing"):
        open_sequence(path, topics={"CAM_FRONT": "/nothing"})


def test_a_calibration_with_cameras_not_found_names_the_option(tmp_path, drive, native, motion):
    path = write_mcap(tmp_path / "bag.mcap", renamed(messages_of(native, motion), AUTOWARE))
    with pytest.raises(InputError, match=r"camera CAM_FRONT of the calibration.*`topics=\{'CAM_FRONT': '/TOPIC'\}`"):
        open_sequence(path, calibration=drive / "calibration.json")
    topics = {"CAM_FRONT": AUTOWARE["/CAM_FRONT/image/compressed"], "CAM_BACK": AUTOWARE["/CAM_BACK/image/compressed"]}
    sequence = open_sequence(path, calibration=drive / "calibration.json", topics=topics)
    assert sequence.rig.names == native.rig.names
    messages = [message for message in messages_of(native, motion) if "CAM_BACK" not in message[0]]
    sequence = open_sequence(write(tmp_path, "mcap", messages), calibration=drive / "calibration.json")
    assert sequence.rig.names == ("CAM_FRONT",)
    assert "without images, left out: CAM_BACK" in sequence.notes


def test_frames_before_the_first_pose_are_left_out(tmp_path, native, motion):
    late = 1_400_000_000
    messages = [m for m in messages_of(native, motion) if m[0] != "/odom" or m[2] >= late]
    sequence = open_sequence(write_mcap(tmp_path / "bag.mcap", messages))
    assert len(sequence.stamps) == 3
    assert any("1 of 4 frames are left out" in note for note in sequence.notes)


@pytest.mark.parametrize("body", ["imu", "CAM_FRONT_optical"])
def test_poses_of_another_part_of_the_vehicle_move_to_the_ego(tmp_path, native, motion, body):
    bodies = {"imu": rigid((1, 2, 3)), "CAM_FRONT_optical": native.rig["CAM_FRONT"].ego_from_camera}
    base_from_body = Pose.from_matrix(bodies[body])
    messages = [m for m in messages_of(native, None) if m[0] != "/odom"]
    messages.append(("/tf_static", "tf2_msgs/TFMessage", 10**9, {"transforms": [
        transform(10**9, "base_link", body, base_from_body)
    ]}))  # fmt: skip
    for time in motion.timestamps_ns.tolist():
        pose = motion.pose_at(time)
        world_from_body = Pose.from_matrix(pose.matrix @ base_from_body.matrix)
        messages.append(("/odom", "nav_msgs/Odometry", time, odometry(time, "map", body, world_from_body)))
    topics = tmp_path / "topics.toml"
    topics.write_text('ego_frame = "base_link"\n')
    path = write_mcap(tmp_path / "bag.mcap", messages)
    for stated in ({}, {"topics_file": topics}):
        assert_posed(open_sequence(path, **stated).load(2), native.load(2))


def test_options_do_not_state_the_poses_of_a_bag(tmp_path, native, motion):
    path = write_mcap(tmp_path / "bag.mcap", messages_of(native, motion))
    with pytest.raises(InputError, match=r"pass `pose_axes` .`--pose-axes`. with the sequence folder"):
        open_sequence(path, pose_axes="frd")


def test_a_chain_of_moving_transforms_is_multiplied(tmp_path, native, motion):
    map_from_odom = Pose(np.array([5.0, 0.0, 0.0]), Pose.from_matrix(np.eye(4)).quaternion)
    messages = messages_of(native, None)
    for time in motion.timestamps_ns.tolist():
        pose = motion.pose_at(time)
        odom_from_base = replace(pose, translation=pose.translation - map_from_odom.translation)
        fields = {"transforms": [transform(time, "odom", "base_link", odom_from_base)]}
        messages.append(("/tf", "tf2_msgs/TFMessage", time, fields))
    for time in motion.timestamps_ns[::6].tolist():
        fields = {"transforms": [transform(time, "map", "odom", map_from_odom)]}
        messages.append(("/tf", "tf2_msgs/TFMessage", time, fields))
    assert_posed(open_sequence(write_mcap(tmp_path / "bag.mcap", messages)).load(2), native.load(2))


LENSES = {
    "plumb_bob": Distortion("brown_conrady", (0.1, -0.02, 0.001, 0.002, 0.01)),
    "rational_polynomial": Distortion("brown_conrady", (0.1, -0.02, 0.001, 0.002, 0.01, 0.02, 0.03, 0.04)),
    "equidistant": Distortion("kannala_brandt", (0.1, -0.02, 0.003, -0.001)),
}


@pytest.mark.parametrize("model", LENSES)
def test_the_distortion_models_of_camera_info(tmp_path, native, motion, model):
    camera = replace(native.rig["CAM_FRONT"], distortion=LENSES[model])
    info = camera_info(camera, 10**9, "CAM_FRONT_optical")
    assert info["distortion_model"] == model
    messages = with_info(messages_of(native, motion), info)
    sequence = open_sequence(write_mcap(tmp_path / "bag.mcap", messages))
    assert sequence.rig["CAM_FRONT"].distortion == LENSES[model]
    assert sequence.rig["CAM_BACK"].distortion is None


def test_a_rectified_image_has_the_rectifications_intrinsics(tmp_path, native, motion):
    camera = replace(native.rig["CAM_FRONT"], distortion=LENSES["plumb_bob"])
    info = camera_info(camera, 10**9, "CAM_FRONT_optical")
    projection = np.array([[40.0, 0, 30, 0], [0, 41, 16, 0], [0, 0, 1, 0]])
    rotation = rotation_about_z(0.1)
    info |= {"p": projection.ravel().tolist(), "r": rotation.ravel().tolist()}
    messages = renamed(messages_of(native, motion), {"/CAM_FRONT/image/compressed": "/CAM_FRONT/image_rect/compressed"})
    messages = with_info(messages, info)
    found = open_sequence(write_mcap(tmp_path / "bag.mcap", messages)).rig["CAM_FRONT"]
    assert found.distortion is None
    np.testing.assert_array_equal(found.intrinsics, projection[:, :3])
    # A point's rectified ray is R times its ray in the camera.
    point_ego = np.array([10.0, 1.0, 2.0])
    in_camera = camera.camera_from_ego[:3, :3] @ point_ego + camera.camera_from_ego[:3, 3]
    in_rectified = found.camera_from_ego[:3, :3] @ point_ego + found.camera_from_ego[:3, 3]
    np.testing.assert_allclose(in_rectified, rotation @ in_camera, atol=1e-12)


def encode(pixels: np.ndarray, encoding: str) -> tuple[np.ndarray, int]:
    """The rows of an image in an encoding, and the bytes a row."""
    if encoding == "bgr8":
        rows = pixels.reshape(len(pixels), -1)
    elif encoding == "rgb8":
        rows = pixels[..., ::-1].reshape(len(pixels), -1)
    elif encoding == "bgra8":
        rows = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=-1).reshape(len(pixels), -1)
    else:
        rows = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    padded = np.pad(rows, ((0, 0), (0, 3)))  # a step that is larger than the row
    return padded, padded.shape[1]


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "bgra8", "mono8"])
def test_raw_images(tmp_path, native, motion, encoding):
    messages = raw_messages(native, motion, lambda pixels: encode(pixels, encoding), encoding)
    frame = open_sequence(write_mcap(tmp_path / "bag.mcap", messages)).load(1)
    for name, image in native.load(1).images.items():
        true = image.pixels_bgr
        if encoding == "mono8":
            true = cv2.cvtColor(cv2.cvtColor(true, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
        np.testing.assert_array_equal(frame.images[name].pixels_bgr, true)


def raw_messages(native: Drive, motion: EgoMotion, encoded, encoding: str) -> list[Message]:
    messages = []
    for topic, kind, time, fields in messages_of(native, motion):
        if kind == "sensor_msgs/CompressedImage":
            pixels = cv2.imdecode(np.frombuffer(fields["data"], np.uint8), cv2.IMREAD_COLOR)
            rows, step = encoded(pixels)
            fields = {
                "header": fields["header"], "height": pixels.shape[0], "width": pixels.shape[1], "encoding": encoding,
                "is_bigendian": 0, "step": step, "data": rows.tobytes(),
            }  # fmt: skip
            topic, kind = topic.replace("image/compressed", "image_raw"), "sensor_msgs/Image"
        messages.append((topic, kind, time, fields))
    return messages


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_image_of_one_colour_has_that_colour(tmp_path, native, motion, pattern):
    levels = {"r": 200, "g": 120, "b": 40}

    def mosaic(pixels: np.ndarray) -> tuple[np.ndarray, int]:
        height, width = pixels.shape[:2]
        tile = np.array([levels[letter] for letter in pattern], dtype=np.uint8).reshape(2, 2)
        rows = np.tile(tile, (height // 2 + 1, width // 2 + 1))[:height, :width]
        return np.ascontiguousarray(rows), width

    messages = raw_messages(native, motion, mosaic, f"bayer_{pattern}8")
    image = open_sequence(write_mcap(tmp_path / "bag.mcap", messages)).load(0).images["CAM_FRONT"]
    np.testing.assert_array_equal(image.pixels_bgr[10, 10], [40, 120, 200])


def test_an_unknown_encoding_is_an_error_a_broken_image_is_a_gap(tmp_path, native, motion):
    messages = raw_messages(native, motion, lambda pixels: encode(pixels, "bgr8"), "32FC1")
    with pytest.raises(InputError, match="encoding 32FC1 is not supported"):
        open_sequence(write_mcap(tmp_path / "bag.mcap", messages)).load(0)
    messages = messages_of(native, motion)
    place = next(i for i, message in enumerate(messages) if message[0] == "/CAM_FRONT/image/compressed")
    topic, kind, time, fields = messages[place]
    messages[place] = (topic, kind, time, {**fields, "data": fields["data"][:40]})
    path = write_mcap(tmp_path / "bag.mcap", messages)
    assert "is not a complete image" in open_sequence(path).load(0).dropped["CAM_FRONT"]
    with pytest.raises(InputError, match="`strict=True`"):
        open_sequence(path, strict=True).load(0)
    path = compressed_bag(tmp_path, native, [("h264", b"\0\0\0\1" * 20)])
    with pytest.raises(
        InputError, match=r"/CAM_BACK/image/compressed: images of format h264 are not read \(expected JP"
    ):
        open_sequence(path, ego_motion="static").load(0)
    with pytest.raises(InputError, match="video format theora is not supported"):
        open_sequence(video_bag(tmp_path, native, [b"abc"], "theora"), ego_motion="static")


def compressed_bag(folder: Path, native: Drive, images: list[tuple[str, bytes]]) -> Path:
    """The small drive with these images in turn: their formats and bytes."""
    messages, left = [], cycle(images)
    for topic, kind, time, fields in messages_of(native, None):
        if kind == "sensor_msgs/CompressedImage":
            stated, encoded = next(left)
            fields = {**fields, "format": stated, "data": encoded}
        messages.append((topic, kind, time, fields))
    return write_mcap(folder / "bag.mcap", messages)


def images_of_bag(path: Path) -> list[CameraImage]:
    """The images of all frames."""
    sequence = open_sequence(path, ego_motion="static")
    frames = [sequence.load(place) for place in range(len(sequence.stamps))]
    return [image for frame in frames for image in frame.images.values()]


def encoded_as(suffix: str, pixels: np.ndarray) -> bytes:
    quality = [cv2.IMWRITE_JPEG_QUALITY, 100] if suffix == ".jpg" else []
    return cv2.imencode(suffix, pixels, quality)[1].tobytes()


def test_compressed_images_that_opencv_reads(tmp_path, native):
    pixels = np.random.default_rng(0).integers(0, 255, (36, 64, 3), dtype=np.uint8)  # OpenCV's WebP is without loss
    images = [(f"bgr8; {kind} compressed bgr8", encoded_as(f".{kind}", pixels)) for kind in ("webp", "tiff", "bmp")]
    images.append(("rgb8; png compressed rgb8", encoded_as(".png", pixels[..., ::-1])))
    for image in images_of_bag(compressed_bag(tmp_path, native, images)):
        np.testing.assert_array_equal(image.pixels_bgr, pixels)
        assert image.encoded is None  # other files are not handed on


def test_a_compressed_bayer_pattern_is_shown_in_colour(tmp_path, native):
    tile = np.array([[200, 120], [120, 40]])  # red top left
    small, wide = (np.tile(tile << shift, (18, 32)).astype(kind) for shift, kind in ((0, np.uint8), (8, np.uint16)))
    coloured = np.full((36, 64, 3), (40, 120, 200), dtype=np.uint8)
    images = [
        ("bayer_rggb8; jpeg compressed bayer_rggb8", encoded_as(".jpg", small)),
        ("bayer_rggb8; jpeg compressed ", encoded_as(".jpg", small)),
        ("bayer_rggb16; png compressed ", encoded_as(".png", wide)),
        ("bayer_rggb8; jpeg compressed bgr8", encoded_as(".jpg", coloured)),
    ]
    for image in images_of_bag(compressed_bag(tmp_path, native, images)):
        np.testing.assert_allclose(image.pixels_bgr[10, 10].astype(int), [40, 120, 200], atol=4)


def foxglove_messages(native: Drive, motion: EgoMotion, time_of) -> list[Message]:
    """The drive in Foxglove's schemas. time_of: nanoseconds -> the schema's time."""
    messages: list[Message] = []
    for topic, kind, time, fields in messages_of(native, motion, poses_in="tf"):
        if kind == "tf2_msgs/TFMessage":
            parts = [
                {
                    "timestamp": time_of(time),
                    "parent_frame_id": one["header"]["frame_id"],
                    "child_frame_id": one["child_frame_id"],
                    **one["transform"],
                }
                for one in fields["transforms"]
            ]
            messages.append((topic, "foxglove.FrameTransforms", time, {"transforms": parts}))
        elif kind == "sensor_msgs/CameraInfo":
            info = {key: fields[key] for key in ("width", "height", "distortion_model")}
            info |= {key.upper(): fields[key] for key in "dkrp"}
            info |= {"timestamp": time_of(time), "frame_id": fields["header"]["frame_id"]}
            messages.append((topic, "foxglove.CameraCalibration", time, info))
        else:
            image = {"timestamp": time_of(time), "frame_id": fields["header"]["frame_id"]}
            image |= {"data": fields["data"], "format": fields["format"]}
            messages.append((topic, "foxglove.CompressedImage", time, image))
    return messages


def foxglove_files():
    """The Protobuf definitions of the Foxglove schemas that are written here."""
    from google.protobuf import descriptor_pb2, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    kinds = {"double": 1, "uint32": 13, "string": 9, "bytes": 12}
    types = {
        "Vector3": "double x,double y,double z",
        "Quaternion": "double x,double y,double z,double w",
        "FrameTransform": ".google.protobuf.Timestamp timestamp,string parent_frame_id,string child_frame_id,"
        ".foxglove.Vector3 translation,.foxglove.Quaternion rotation",
        "FrameTransforms": "*.foxglove.FrameTransform transforms",
        "CompressedImage": ".google.protobuf.Timestamp timestamp,string frame_id,bytes data,string format",
        "CameraCalibration": ".google.protobuf.Timestamp timestamp,string frame_id,uint32 width,uint32 height,"
        "string distortion_model,*double D,*double K,*double R,*double P",
    }
    for name, text in types.items():
        message = file.message_type.add(name=name)
        for number, field in enumerate(text.split(","), start=1):
            kind, key = field.split(" ")
            repeated, kind = kind.startswith("*"), kind.removeprefix("*")
            added = message.field.add(name=key, number=number, label=3 if repeated else 1, type=kinds.get(kind, 11))
            if kind not in kinds:
                added.type_name = kind
    files = descriptor_pb2.FileDescriptorSet()
    files.file.add().CopyFrom(descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb))
    files.file.append(file)
    return files


@pytest.mark.parametrize("form", ["json", "protobuf"])
def test_foxglove_schemas(tmp_path, native, motion, form):
    path = tmp_path / "bag.mcap"
    if form == "json":
        write_json_mcap(path, foxglove_messages(native, motion, lambda t: {"sec": t // 10**9, "nsec": t % 10**9}))
    else:
        times = lambda t: f"1970-01-01T00:00:{t // 10**9:02d}.{t % 10**9:09d}Z"  # noqa: E731
        write_protobuf_mcap(path, foxglove_messages(native, motion, times), foxglove_files())
    sequence = open_sequence(path)
    found, true = sequence.load(2), native.load(2)
    for name, image in true.images.items():
        np.testing.assert_array_equal(found.images[name].pixels_bgr, image.pixels_bgr)
        assert_posed(found, true, name)
        np.testing.assert_allclose(sequence.rig[name].ego_from_camera, native.rig[name].ego_from_camera, atol=1e-12)


@pytest.mark.parametrize("schema", ["foxglove.FrameTransforms", "foxglove.CompressedImage"])
def test_a_time_beyond_64_bits_is_that_of_recording(tmp_path, native, motion, schema):
    messages = foxglove_messages(native, motion, lambda t: {"sec": t // 10**9, "nsec": t % 10**9})
    kind, place = next((one[1], i) for i, one in enumerate(messages) if one[1] == schema and one[0] != "/tf_static")
    topic, _, time, fields = messages[place]
    fields = json.loads(json.dumps(fields, default=lambda data: base64.b64encode(data).decode()))
    (fields["transforms"][0] if "transforms" in fields else fields)["timestamp"]["sec"] = 10**15
    messages[place] = (topic, kind, time, fields)
    found = open_sequence(write_json_mcap(tmp_path / "bag.mcap", messages))
    assert len(found.stamps) == 4
    assert found.load(0).images["CAM_BACK"].timestamp_ns == native.load(0).images["CAM_BACK"].timestamp_ns


def test_a_folder_without_metadata_and_a_ros1_bag(tmp_path, native, motion):
    bag = write_rosbag2(tmp_path / "bag", messages_of(native, motion))
    (bag / "metadata.yaml").unlink()  # a recording that was cut off has none
    assert len(open_sequence(bag).stamps) == 4
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InputError, match="is a bag of ROS 1: convert it"):
        open_sequence(tmp_path / "old.bag")
    (tmp_path / "folder.bag").mkdir()
    with pytest.raises(InputError, match=r"folder\.bag: is a bag of ROS 1: convert it"):
        open_sequence(tmp_path / "folder.bag")
    for name in ("drive.mcap.zst", "drive.db3.gz", "packed/drive_0.mcap.zst"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"packed")
        path = path.parent if name.startswith("packed") else path
        with pytest.raises(InputError, match=rf"{path.name}: .* compressed: decompress .*zstd -d drive"):
            open_sequence(path)


def test_messages_of_ros_1_in_an_mcap_are_named_with_the_remedy(tmp_path):
    path = write_encoded(
        tmp_path / "old.mcap",
        [("/cam/image", "sensor_msgs/CompressedImage", 1, {}), ("/cam/camera_info", "sensor_msgs/CameraInfo", 1, {})],
        lambda fields: b"\0" * 20, "ros1", "ros1msg", lambda kind: b"",
    )  # fmt: skip
    with pytest.raises(InputError, match=r"old\.mcap: .*encoded as ros1.*rosbags-convert"):
        open_sequence(path)


def video_bag(folder: Path, native: Drive, packets: list[bytes], video_format: str) -> Path:
    """The small drive with CAM_FRONT as a video of ten images per second."""
    messages = [m for m in messages_of(native, None) if m[0] != "/CAM_FRONT/image/compressed"]
    camera = replace(native.rig["CAM_FRONT"], width=64, height=48)
    messages = with_info(messages, camera_info(camera, 10**9, "CAM_FRONT_optical"))
    for number, packet in enumerate(packets):
        time = 10**9 + number * 100_000_000
        timestamp = {"sec": time // 10**9, "nanosec": time % 10**9}
        fields = {"timestamp": timestamp, "frame_id": "CAM_FRONT_optical", "data": packet, "format": video_format}
        messages.append(("/CAM_FRONT/video", "foxglove_msgs/CompressedVideo", time, fields))
    return write_mcap(folder / "bag.mcap", messages)


@pytest.mark.parametrize("video_format", ["h264", "h265"])
def test_video_packets_are_decoded_in_any_order(tmp_path, native, video_format):
    stored = json.loads((Path(__file__).parents[1] / "data/video_packets.json").read_text())
    packets = [base64.b64decode(text) for text in stored[video_format]]
    sequence = open_sequence(video_bag(tmp_path, native, packets, video_format), ego_motion="static")
    assert "/CAM_FRONT/video" in sequence.notes[0]
    for place in (1, 0, 2):  # at 1.5, 1.0 and 2.0 s; CAM_BACK, which leads, is 20 ms late
        image = sequence.load(place).images["CAM_FRONT"]
        assert image.timestamp_ns == 10**9 + place * 500_000_000
        assert image.pixels_bgr.mean() == pytest.approx(10 + 20 * 5 * place, abs=5)


def test_without_the_extra_the_error_names_it(tmp_path, native, motion, monkeypatch):
    path = write_mcap(tmp_path / "bag.mcap", messages_of(native, motion))
    monkeypatch.setattr("bevcli.workshop.formats.BAG_PACKAGES", ("rosbags", "a_package.that_is_missing"))
    with pytest.raises(InputError, match=r"run pip install 'bevcli\[ros\]'"):
        open_sequence(path)


def nav_sat_fix(time: int, latitude: float, longitude: float, status: int = 0) -> Message:
    fields = {"header": header(time, "gnss"), "status": {"status": status, "service": 1}}
    fields |= {"latitude": latitude, "longitude": longitude, "altitude": 0.0}
    fields |= {"position_covariance": [0.0] * 9, "position_covariance_type": 0}
    return "/gnss/fix", "sensor_msgs/NavSatFix", time, fields


def test_the_first_valid_satellite_fix_places_the_drive_on_earth(native, motion, tmp_path):
    times = [stamp.timestamp_ns for stamp in native.stamps]
    fixes = [nav_sat_fix(times[0], 0.0, 0.0, status=-1), nav_sat_fix(times[1], 48.137, 11.575)]
    path = write_mcap(tmp_path / "drive.mcap", [*messages_of(native, motion), *fixes])
    opened = open_sequence(path)
    vehicle = opened.load(1).world_from_ego.translation
    assert opened.facts.geo_origin.latitude_longitude(vehicle) == pytest.approx([48.137, 11.575], abs=1e-5)  # a metre
    path = write_mcap(tmp_path / "drive.mcap", messages_of(native, motion))
    assert open_sequence(path).facts.geo_origin is None
    with pytest.raises(InputError, match='has no scene "one"'):
        open_sequence(path, scene="one")
