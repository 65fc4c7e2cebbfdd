"""A model called with the images of one frame, and what wrong arguments are told."""

from pathlib import Path

import numpy as np
import pytest
from memory_drive import MemoryDrive

import bevcli
from bevcli.errors import InputError, WeightsError

DRIVE = MemoryDrive(1)


@pytest.fixture(scope="module")
def model(mini_model):
    return bevcli.Model(mini_model)


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


def test_the_package_says_that_it_is_typed():
    assert (Path(bevcli.__file__).parent / "py.typed").is_file()
