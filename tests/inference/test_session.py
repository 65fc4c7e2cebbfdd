"""A session, and a model called with one frame: they give what a run gives, and what they refuse."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from memory_drive import MemoryDrive, WithoutImages, make_rig

import bevcli
from bevcli.errors import InputError, WeightsError
from bevcli.frame import StartReason
from bevcli.geometry.ego_motion import GRAVITY
from bevcli.geometry.transforms import rigid, rotation_about_z
from bevcli.recording import entities
from bevcli.viewer.recording_reader import RecordingReader

COLUMNS = ("centers", "sizes_lwh", "yaws", "velocities", "scores", "track_scores", "duplicates")


@pytest.fixture(scope="module")
def model(mini_model):
    return bevcli.Model(mini_model)


def step(session, frame, **changes):
    """A step with all that a frame holds."""
    images = {name: image.pixels_bgr for name, image in frame.images.items()}
    given = {
        "images": images,
        "world_from_ego": frame.world_from_ego,
        "timestamp_ns": frame.stamp.timestamp_ns,
        "world_from_ego_at": frame.world_from_ego_at,
        "kinematics": frame.kinematics,
    }
    return session.step(**given | changes)


def assert_same(one, other):
    for name in COLUMNS:
        assert np.asarray(getattr(one.boxes, name)).tobytes() == np.asarray(getattr(other.boxes, name)).tobytes(), name
    assert list(one.boxes.classes) == list(other.boxes.classes)
    assert one.skipped or list(one.boxes.instances) == list(other.boxes.instances)
    assert (one.bev is None and other.bev is None) or one.bev.equal(other.bev)
    assert (one.started_anew, one.skipped) == (other.started_anew, other.skipped)


@pytest.mark.parametrize("temporal", [True, False])
def test_a_session_equals_a_run_to_the_byte(model, temporal):
    drive = WithoutImages({1: ("CAM_BACK",), 3: "all"}, count=5)
    session = bevcli.Session(model, drive.rig, temporal=temporal)
    for frame, expected in bevcli.run(model, drive, temporal=temporal):
        assert_same(step(session, frame), expected)


def test_rgb_images_are_those_of_the_other_order(model):
    drive = MemoryDrive(1)
    frame, expected = next(bevcli.run(model, drive))
    images = {name: image.pixels_bgr[..., ::-1] for name, image in frame.images.items()}
    assert_same(step(bevcli.Session(model, drive.rig, color_order="rgb"), frame, images=images), expected)


def test_a_gap_begins_anew_and_a_reset_too(model):
    frame, session = MemoryDrive(1).load(0), bevcli.Session(model, make_rig())
    times = [0, 500_000_000, 10_000_000_000]
    begun = [step(session, frame, timestamp_ns=time).started_anew for time in times]
    assert [None if one is None else one.reason for one in begun] == [StartReason.FIRST_FRAME, None, StartReason.GAP]
    session.reset()
    again = step(session, frame, timestamp_ns=0)
    assert again.started_anew.reason is StartReason.FIRST_FRAME
    assert (again.stamp.index, again.stamp.scene) == (3, "2")


def test_frames_out_of_order_change_nothing(model):
    drive = MemoryDrive(3)
    session = bevcli.Session(model, drive.rig)
    expected = [prediction for _, prediction in bevcli.run(model, drive)]
    for place in range(3):
        assert_same(step(session, drive.load(place)), expected[place])
        with pytest.raises(InputError, match=r"is not later than the frame before .*reset\(\)"):
            step(session, drive.load(place))
        with pytest.raises(InputError, match=r"`timestamp_ns`: is too large"):
            step(session, drive.load(place), timestamp_ns=2**63)


WRONG_IMAGES = [
    ({"CAM_LEFT": np.zeros((180, 320, 3), np.uint8)}, "camera CAM_LEFT is not in the rig"),
    ({"CAM_FRONT": np.zeros((90, 160, 3), np.uint8)}, r"expected uint8 of shape \(180, 320, 3\).*\(90, 160, 3\)"),
    ({"CAM_FRONT": np.zeros((180, 320, 3), np.float32)}, "found float32"),
    ({"CAM_FRONT": None}, "found NoneType"),
]


@pytest.mark.parametrize(("images", "message"), WRONG_IMAGES)
def test_other_images_are_refused(model, images, message):
    with pytest.raises(InputError, match=message):
        step(bevcli.Session(model, make_rig()), MemoryDrive(1).load(0), images=images)


@pytest.mark.parametrize("pose", [np.eye(3), np.diag([1, 1, 2, 1]), np.diag([1, 1, -1, 1]), np.full((4, 4), np.nan)])
def test_poses_that_are_not_rigid_are_refused(model, pose):
    with pytest.raises(InputError, match=r"`world_from_ego`: (expected a Pose|is not a rigid transform)"):
        step(bevcli.Session(model, make_rig()), MemoryDrive(1).load(0), world_from_ego=pose)


def test_a_session_that_cannot_be_is_refused(model, window_model):
    rig = make_rig()
    with pytest.raises(InputError, match='`color_order=yuv`: expected "bgr" or "rgb"'):
        bevcli.Session(model, rig, color_order="yuv")
    with pytest.raises(InputError, match="found CAM_FRONT, CAM_FRONT"):
        bevcli.Session(model, replace(rig, cameras=rig.cameras[:1] * 2))
    with pytest.raises(InputError, match="model mini uses 1 later frames"):
        bevcli.Session(bevcli.Model(window_model(-1, 0, 1)), rig)


@pytest.mark.parametrize("rate_hz", [2, 30])
def test_motion_is_derived_from_the_poses(model, rate_hz):
    """A circle at constant speed: 6 m/s, 0.3 rad/s."""
    session = bevcli.Session(model, make_rig())
    for k in range(1 + 6 * rate_hz // 5):
        yaw = 0.3 * k / rate_hz
        pose = rigid((20 * np.sin(yaw), 20 * (1 - np.cos(yaw)), 0), rotation_about_z(yaw))
        session.step({}, pose, 10**18 + round(k / rate_hz * 1e9))
    motion = session.frame.kinematics
    np.testing.assert_allclose(motion.velocity, [6, 0, 0], atol=0.5)
    np.testing.assert_allclose(motion.angular_rate, [0, 0, 0.3], atol=0.01)
    np.testing.assert_allclose(motion.acceleration, [0, 1.8, GRAVITY], atol=0.3)


def test_a_recording_follows_a_session(model, tmp_path: Path):
    drive = MemoryDrive(2)
    session = bevcli.Session(model, drive.rig, name="car 7")
    with bevcli.Recording(tmp_path / "live.rrd", session, model) as recording:
        for place in range(2):
            prediction = step(session, drive.load(place))
            recording.log(session.frame, prediction)
    recorded = list(RecordingReader(tmp_path / "live.rrd").frames())
    assert [frame.index for frame in recorded] == [0, 1]
    for name in session.rig.names:
        assert recorded[1].has(entities.image(name), "EncodedImage:blob")


DRIVE = MemoryDrive(1)


@pytest.fixture(scope="module")
def images():
    return {name: image.pixels_bgr for name, image in DRIVE.load(0).images.items()}


def test_a_call_equals_the_first_step_of_a_vehicle_that_stands(model, images):
    called = model(images, DRIVE.rig)
    stepped = bevcli.Session(model, DRIVE.rig).step(images, bevcli.Pose.identity(), 0)
    assert np.array_equal(called.boxes.to_numpy(), stepped.boxes.to_numpy())
    assert str(called.started_anew) == "first frame"
    assert called.frame.images.keys() == set(DRIVE.rig.names)
    assert called.boxes.instances is None
    assert called.untrained
    turned = {name: pixels[..., ::-1] for name, pixels in images.items()}
    assert np.array_equal(model(turned, DRIVE.rig, color_order="rgb").boxes.centers, called.boxes.centers)


def test_a_call_takes_the_path_of_a_calibration(model):
    path = Path(__file__).parents[2] / "samples/street/calibration.json"
    images = {"CAM_FRONT": np.random.default_rng(0).integers(0, 256, (450, 800, 3), dtype=np.uint8)}
    found, rig = model(images, path), bevcli.read_calibration(path)
    assert found.frame.dropped.keys() == set(rig.names) - {"CAM_FRONT"}
    assert np.array_equal(found.boxes.centers, model(images, rig).boxes.centers)


def test_a_call_without_calibration_says_what_to_pass(model, images):
    with pytest.raises(InputError, match=r"`calibration` is missing: .*: pass a calibration\.json, or a CameraRig"):
        model(images)
    with pytest.raises(InputError, match="`calibration` is a tuple: "):
        model(images, DRIVE.rig.cameras)


def test_wrong_arguments_are_told_what_to_pass(model, images):
    session = bevcli.Session(model, DRIVE.rig)
    here = bevcli.Pose.identity()
    with pytest.raises(InputError, match=r'expected a mapping .* such as \{"CAM_FRONT": image\} \(found list of 6\)'):
        session.step(list(images.values()), here, 0)
    with pytest.raises(InputError, match=r"\(found ndarray\)"):
        model(images["CAM_FRONT"], DRIVE.rig)
    with pytest.raises(InputError, match=r"\(found float 1\.5\): pass round\(seconds \* 1e9\)"):
        session.step(images, here, 1.5)
    with pytest.raises(InputError, match="pass an int"):
        session.step(images, here, "now")
    expected = r"`model=mine\.pth` \(`--model`\): is a file of weights: pass it as `weights=mine\.pth`"
    with pytest.raises(WeightsError, match=expected):
        bevcli.load_model("mine.pth")
    with pytest.raises(InputError, match=r"`sequence=drive`: .*: pass what `bevcli\.open_sequence` returns"):
        bevcli.run(model, "drive")
    with pytest.raises(InputError, match=r"`model=demo`: .*: pass what `bevcli\.load_model` returns"):
        bevcli.run("demo", DRIVE)


def test_objects_of_the_api_are_described_in_one_line(model, images):
    prediction = model(images, DRIVE.rig)
    front = bevcli.CameraRig(DRIVE.rig.cameras[:1], DRIVE.rig.ego_from_bev)
    described = {
        "Model(mini, random weights, fp32 on cpu by torch)": model,
        "CameraRig(CAM_FRONT 320x180)": front,
        f"Prediction(frame 0, {len(prediction.boxes)} boxes)": prediction,
        "Frame(frame 0, images of CAM_FRONT)": model({"CAM_FRONT": images["CAM_FRONT"]}, front).frame,
        "MemoryDrive(memory, 1 frame, 6 cameras)": DRIVE,
    }
    assert {repr(each) for each in described.values()} == described.keys()


def test_a_step_during_the_step_of_another_thread_is_refused(model, monkeypatch):
    drive = MemoryDrive(2, make_rig({"CAM_FRONT": 0.0}))
    session, refused = bevcli.Session(model, drive.rig), []
    prepare = session._runner.prepare

    def meanwhile(frame):
        def other():
            with pytest.raises(InputError, match="another thread is in a step of this session"):
                step(session, drive.load(0))
            refused.append(True)

        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        return prepare(frame)

    monkeypatch.setattr(session._runner, "prepare", meanwhile)
    step(session, drive.load(0))
    assert refused == [True]
    monkeypatch.setattr(session._runner, "prepare", prepare)
    step(session, drive.load(1))


def test_sessions_of_several_threads_give_the_results_of_one(model):
    drive = MemoryDrive(3, make_rig({"CAM_FRONT": 0.0, "CAM_BACK": np.pi}))
    frames = [drive.load(place) for place in range(3)]

    def through(_):
        session = bevcli.Session(model, drive.rig)
        return [step(session, frame) for frame in frames]

    expected = through(0)
    with ThreadPoolExecutor(3) as pool:
        for found in pool.map(through, range(3)):
            for one, other in zip(expected, found, strict=True):
                assert_same(one, other)
