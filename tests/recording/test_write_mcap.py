"""`bevcli convert --format mcap`: read back by the mcap library with its ROS 2 decoder, and by the reader of bags."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from memory_drive import MemoryDrive
from recorded_drive import with_truth

from bevcli.errors import BevcliError, InputError, OutputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig, Distortion
from bevcli.geometry.transforms import rotation_from_quaternion
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats import WriteOptions
from bevcli.workshop.formats.convert import open_writer
from bevcli.workshop.formats.mcap_writer import Messages


class Truthful(MemoryDrive):
    """The drive in memory with ground truth, and a lens of eight coefficients in front."""

    def __init__(self):
        super().__init__(3)
        lens = Distortion("brown_conrady", (-0.2, 0.05, 0.001, 0, 0.01, 0, 0, 0))
        front, *others = self.rig.cameras
        front = Camera(front.name, front.width, front.height, front.intrinsics, front.ego_from_camera, lens)
        self.rig = CameraRig((front, *others), self.rig.ego_from_bev)

    def load(self, place):
        return with_truth(super().load(place))


def ego_box(score: float) -> Boxes3D:
    """A car 10 m ahead, 2 m to the left, that heads left."""
    return Boxes3D(
        np.array([[10.0, 2, 0.8]]), np.array([[4.0, 1.8, 1.6]]), np.array([np.pi / 2]), np.array([[0.0, 3]]),
        np.array(["car"]), scores=np.array([score]), instances=np.array(["7"]),
    )  # fmt: skip


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    folder, drive = tmp_path_factory.mktemp("mcap"), Truthful()
    with BoxesWriter(folder / "predictions.json", "ego") as boxes:
        for stamp, score in zip(drive.stamps[:2], (0.9, 0.1), strict=True):
            boxes.write(FrameBoxes(FrameStamp(stamp.index, stamp.scene, stamp.timestamp_ns), None, ego_box(score)))
    options = WriteOptions(form="mcap", boxes=folder / "predictions.json")
    with open_writer(folder / "drive.mcap", drive, options) as writer:
        for place in range(3):
            writer.write(drive.load(place))
    return folder / "drive.mcap"


@pytest.fixture(scope="module")
def messages(file):
    """Topic -> its messages, decoded by the mcap library."""
    found: dict[str, list] = {}
    with file.open("rb") as opened:
        for _, channel, _, message in make_reader(opened, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def test_the_mcap_library_reads_every_topic(messages):
    cameras = [f"/{name}/{part}" for name in Truthful().rig.names for part in ("image/compressed", "camera_info")]
    others = ["/tf_static", "/tf", "/odom", "/ground_truth", "/predictions"]
    assert messages.keys() == {*cameras, *others}
    assert {topic: len(found) for topic, found in messages.items() if len(found) != 3} == {"/tf_static": 1}


def test_images_and_calibrations_are_those_of_the_drive(messages):
    frame = Truthful().load(1)
    image, info = messages["/CAM_FRONT/image/compressed"][1], messages["/CAM_FRONT/camera_info"][1]
    assert np.array_equal(cv2.imdecode(np.frombuffer(image.data, np.uint8), 1), frame.images["CAM_FRONT"].pixels_bgr)
    assert image.header.frame_id == info.header.frame_id == "CAM_FRONT_optical"
    assert info.header.stamp.sec * 10**9 + info.header.stamp.nanosec == frame.stamp.timestamp_ns
    assert np.array_equal(np.reshape(info.k, (3, 3)), frame.rig["CAM_FRONT"].intrinsics)
    assert (info.distortion_model, list(info.d)[:2]) == ("rational_polynomial", [-0.2, 0.05])


def test_a_box_stands_in_the_map_where_the_vehicle_saw_it(messages):
    frame = Truthful().load(0)
    [entity] = messages["/predictions"][0].entities
    [cube] = entity.cubes
    seen = frame.world_from_ego.matrix @ [10, 2, 0.8, 1]
    position, q = cube.pose.position, cube.pose.orientation
    assert (position.x, position.y, position.z) == pytest.approx(seen[:3])
    assert (cube.size.x, cube.size.y, cube.size.z) == (4.0, 1.8, 1.6)
    ahead = rotation_from_quaternion([q.w, q.x, q.y, q.z])[:, 0]
    np.testing.assert_allclose(ahead, frame.world_from_ego.matrix[:3, 1], atol=1e-9)
    assert {pair.key: pair.value for pair in entity.metadata}["track"] == "7"
    assert (entity.frame_id, entity.texts[0].text) == ("map", "car 0.90")


def test_each_scene_replaces_the_one_before(messages):
    assert [len(one.entities) for one in messages["/predictions"]] == [1, 0, 0]  # below the score; not in the run
    assert [len(one.entities) for one in messages["/ground_truth"]] == [2, 2, 2]
    assert all(one.deletions[0].type == 1 for one in messages["/ground_truth"])


def test_the_reader_of_bags_gives_the_same_frames(file):
    one, other = Truthful(), open_sequence(file, rate_hz="all")
    assert [stamp.timestamp_ns for stamp in other.stamps] == [stamp.timestamp_ns for stamp in one.stamps]
    for place in range(3):
        a, b = one.load(place), other.load(place)
        assert set(a.rig.names) == set(b.rig.names)
        np.testing.assert_allclose(a.world_from_ego.matrix, b.world_from_ego.matrix, atol=1e-12)
        for name, image in a.images.items():
            np.testing.assert_array_equal(image.pixels_bgr, b.images[name].pixels_bgr)
            np.testing.assert_allclose(a.rig[name].ego_from_camera, b.rig[name].ego_from_camera, atol=1e-12)
            np.testing.assert_array_equal(a.rig[name].intrinsics, b.rig[name].intrinsics)
            assert a.rig[name].distortion == b.rig[name].distortion


def test_existing_files_and_boxes_of_another_drive_are_refused(file, tmp_path):
    with pytest.raises(OutputError, match="exists already: choose another file, or pass `force=True`"):
        open_writer(file, Truthful(), WriteOptions("mcap"))
    other = MemoryDrive(3, scenes="bbb")
    options = WriteOptions("mcap", boxes=file.parent / "predictions.json")
    with pytest.raises(InputError, match="has none of the frames of memory"):
        open_writer(tmp_path / "a.mcap", other, options)


def test_left_out_fields_are_zero_or_empty():
    messages = Messages()
    definition = messages.definition("foxglove_msgs/SceneUpdate")
    assert definition.count("MSG: foxglove_msgs/") == 12
    assert messages.encode("foxglove_msgs/SceneUpdate", {})[4:] == bytes(8)  # two empty lists


def test_without_rosbags_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for name in [name for name in sys.modules if name.startswith("rosbags.")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(BevcliError, match=r"pip install .*bevcli\[ros\]"):
        open_writer(tmp_path / "drive.mcap", Truthful(), WriteOptions(form="mcap"))
