"""The gap of a rig: its differences in words, the polar map, and the command, on made-up boxes but for a slow test."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from bevcli.cli.main import app
from bevcli.config import load_config
from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig, Distortion
from bevcli.rig import drawings
from bevcli.rig.rig_checks import mounting_of, seen_fov_deg
from bevcli.sequences.files.calibration_file import write_calibration
from bevcli.workshop.synth.rig import nuscenes_like_rig
from bevcli.workshop.trust import gap_option, rig_gap
from bevcli.workshop.trust.rig_differences import known_rigs, looking, reach_m, rig_differences, taken_back

DEMO, RANGE_M = load_config("demo"), 32.0
KNOWN = known_rigs(DEMO)
LOUD = {"catch_exceptions": False}


def tilted(name: str, pitch_deg: float) -> CameraRig:
    """The default rig with a camera that looks up or down."""
    rig = nuscenes_like_rig()
    turned = rig[name].ego_from_camera.copy()
    turned[:3, :3] = looking(float(np.degrees(rig[name].yaw)), pitch_deg, 0)
    camera = replace(rig[name], ego_from_camera=turned)
    return replace(rig, cameras=tuple(camera if one.name == name else one for one in rig.cameras))


def test_angles_of_a_camera_are_those_that_it_was_turned_by():
    pose = np.eye(4)
    pose[:3, :3] = looking(100.0, -17.0, 4.0)
    mounting = mounting_of(pose)
    assert (mounting.yaw_deg, mounting.pitch_deg, mounting.roll_deg) == pytest.approx((100, -17, 4))


def test_a_rig_like_the_training_rig_has_no_difference():
    assert rig_differences(nuscenes_like_rig(), KNOWN, RANGE_M) == ()


def test_a_camera_14_deg_further_down_is_named_with_its_reach():
    rig = tilted("CAM_FRONT_LEFT", -17.0)
    (found,) = rig_differences(rig, KNOWN, RANGE_M)
    assert (found.kind, found.cameras) == ("pitch", ("CAM_FRONT_LEFT",))
    assert found.text.startswith(
        "CAM_FRONT_LEFT looks 14° further down than any training camera (-17°, theirs -3 to 3°)"
    )
    back = taken_back(rig, "pitch", KNOWN, RANGE_M)
    assert rig_differences(back, KNOWN, RANGE_M) == ()
    assert mounting_of(back["CAM_FRONT_LEFT"].ego_from_camera).pitch_deg == pytest.approx(-3)
    assert np.allclose(back["CAM_BACK"].ego_from_camera, rig["CAM_BACK"].ego_from_camera)


def test_the_reach_ends_where_the_upper_ray_meets_0_8_m():
    rig = tilted("CAM_FRONT", -27.0)
    upper = np.radians(27) - np.arctan(450 / 1266)  # below the horizon
    expected = 1.72 + (1.50 - 0.8) / np.tan(upper)
    assert reach_m(rig, RANGE_M)[0] == pytest.approx(expected, abs=0.5)
    assert f"beyond {reach_m(rig, RANGE_M)[0]:.0f} m ahead" in rig_differences(rig, KNOWN, RANGE_M)[0].text


def test_a_blind_sector_is_named_and_gets_a_camera():
    rig = nuscenes_like_rig()
    rig = replace(rig, cameras=tuple(one for one in rig.cameras if one.name != "CAM_BACK"))
    (found,) = rig_differences(rig, KNOWN, RANGE_M)
    assert found.kind == "blind sector"
    assert "at the back" in found.text
    assert taken_back(rig, "blind sector", KNOWN, RANGE_M).names[5:] == ("ADDED_CAM_BACK",)


def test_heights_go_to_the_nearest_known_one():
    rig = nuscenes_like_rig()
    up = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 2.4], [0, 0, 0, 0]])
    rig = replace(rig, cameras=tuple(replace(one, ego_from_camera=one.ego_from_camera + up) for one in rig.cameras))
    (found,) = rig_differences(rig, KNOWN, RANGE_M)
    assert found.text.startswith("all 6 cameras are up to 1.2 m higher than any training camera (4.0 m")
    heights = [one.ego_from_camera[2, 3] for one in taken_back(rig, "height", KNOWN, RANGE_M).cameras]
    assert heights == pytest.approx([2.8] * 6)


@pytest.mark.parametrize("lens", [None, Distortion("kannala_brandt", (0.0, 0.0, 0.0, 0.0))])
def test_wide_views_go_to_the_widest_known_one(lens):
    rig = nuscenes_like_rig()
    back = rig["CAM_BACK"]
    intrinsics = back.intrinsics * [[0.35], [0.35], [1]] + [[0, 0, 520], [0, 0, 292.5], [0, 0, 0]]  # about its centre
    wide = replace(back, intrinsics=intrinsics, distortion=lens)
    before = seen_fov_deg(wide)[0]
    after = taken_back(replace(rig, cameras=(wide,)), "field of view", KNOWN, RANGE_M).cameras[0]
    assert before > 140
    assert seen_fov_deg(after)[0] == pytest.approx(132, abs=0.5)


def test_a_slow_and_dark_drive_is_told():
    image = SimpleNamespace(pixels_bgr=np.full((9, 16, 3), 20, np.uint8))
    drive = SimpleNamespace(
        stamps=[FrameStamp(k, "", k * 10**9) for k in range(5)], load=lambda place: SimpleNamespace(images={"A": image})
    )
    rate, light = gap_option.of_drive(drive, DEMO)
    assert (rate.text, rate.amount) == ("1 images a second of each camera (theirs 2)", 2)
    assert light.text.startswith("dark images: mean grey 20")
    thin, even = rig_gap.trial(nuscenes_like_rig(), [rate], KNOWN, RANGE_M)
    assert (thin.every, even.every, thin.frames, even.frames) == (2, 1, 7, 7)
    assert rig_gap.trial(nuscenes_like_rig(), [light], KNOWN, RANGE_M)[0].darkness == 3


def test_frames_of_a_lower_rate_meet_those_of_the_same_time():
    thin, even = (rig_gap.Shot(nuscenes_like_rig(), 7, every) for every in (2, 1))
    seeds = range(len(rig_gap.STREETS))
    boxes = [tuple((seed, index) for seed in seeds for index in range(0, 7, shot.every)) for shot in (thin, even)]
    both = rig_gap.comparable((thin, boxes[0]), (even, boxes[1]))
    assert both[0] == both[1] == tuple((seed, index) for seed in seeds for index in (2, 4, 6))


def test_the_polar_map_counts_boxes_where_they_are():
    places = np.array([[10.0, 0.1], [10, -0.1], [0, 20], [-31, 0.5], [5, -5]])  # ahead twice, left, back, front right
    found = np.array([True, False, True, False, True])
    cells = rig_gap.polar_map(places, found, RANGE_M)
    assert {tuple(cell) for cell in np.argwhere(cells.counts)} == {(0, 1), (4, 2), (8, 3), (14, 0)}
    assert (cells.counts[0, 1], cells.found[0, 1], cells.found[8, 3], cells.found[14, 0]) == (2, 1, 0, 1)
    assert (cells.counts.sum(), cells.found.sum()) == (5, 3)


def test_one_object_of_many_frames_is_within_noise():
    before = SimpleNamespace(objects=np.repeat(0, 12), found=np.ones(12, bool))
    assert not rig_gap.is_clear(before, SimpleNamespace(found=np.zeros(12, bool)))
    before.objects = np.arange(12)
    assert rig_gap.is_clear(before, SimpleNamespace(found=np.zeros(12, bool)))
    assert not rig_gap.is_clear(before, before)


def made_up_boxes(model, shot, after_frame=lambda: None):
    """16 frames of the same objects all around. A camera that looks far down finds none of those on the left."""
    pitches = [mounting_of(camera.ego_from_camera).pitch_deg for camera in shot.rig.cameras]
    random, frames = np.random.default_rng(0), []
    for _ in range(len(rig_gap.STREETS) * rig_gap.FRAMES):
        angles, distances = np.arange(24) * np.pi / 12, random.uniform(6, 30, 24)
        centers = np.stack([distances * np.cos(angles), distances * np.sin(angles), np.full(24, 0.8)], axis=-1)
        sizes, names = np.tile([4.5, 1.9, 1.6], (24, 1)), np.array([f"{place}" for place in range(24)])
        cars, moving = np.full(24, "car"), np.zeros((24, 2))
        true = Boxes3D(centers, sizes, np.zeros(24), moving, cars, instances=names, num_points=np.ones(24, int))
        left = (angles > 0.4) & (angles < 2.7) & (min(pitches) < -10)
        found, scores = ~left & (random.random(24) < 0.8), random.uniform(0.3, 0.9, 24)
        predicted = replace(true[found], scores=scores[found], num_points=None)
        frames.append((predicted, true))
        after_frame()
    return tuple(frames)


@pytest.fixture
def project_debug(tmp_path, monkeypatch):
    """A function that runs the command with made-up boxes and without the other pictures, and returns its output."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(gap_option, "boxes_of", made_up_boxes)
    monkeypatch.setattr(rig_gap, "RESAMPLES", 40)
    for name in ("write_camera_sheet", "write_coverage_map", "write_rig_recording"):
        monkeypatch.setattr(drawings, name, lambda path, *content: path.touch())
    write_calibration(tmp_path / "a.json", tilted("CAM_FRONT_LEFT", -17.0))
    write_calibration(tmp_path / "b.json", nuscenes_like_rig())

    def run(*arguments):
        done = CliRunner().invoke(app, ["project-debug", *map(str, arguments), "--out", str(tmp_path / "out")])
        assert done.exit_code == 0, done.output
        return done.stdout

    return run


def test_the_command_prints_what_a_tilted_camera_costs(project_debug, tmp_path):
    text = project_debug(tmp_path / "a.json", "--model", "demo")
    assert "CAM_FRONT_LEFT looks 14° further down" in text
    assert "instead of" in text
    assert "within noise" not in text.split("a: what differs")[1]
    assert (tmp_path / "out/rig_gap.png").stat().st_size > 20_000
    gap = json.loads((tmp_path / "out/findings.json").read_text())["rig_gap"]
    assert gap["objects"] == 16 * 24
    (cost,) = gap["rigs"]["a"]["costs"]
    low, high = cost["gain"]["interval"]
    assert 0 < low < cost["gain"]["difference"] < high
    assert gap["rigs"]["a"]["found"] < 0.6 < gap["rigs"]["training rig"]["found"]


def test_two_rigs_are_compared(project_debug, tmp_path, monkeypatch):
    monkeypatch.setattr("bevcli.workshop.trust.rig_gap_picture.write_picture", lambda path, *rest: path.touch())
    text = project_debug(tmp_path / "a.json", "--against", tmp_path / "b.json")
    assert "b - a" in text
    assert "b: nothing differs" in text
    equal = next(line for line in text.splitlines() if line.startswith("b - training rig"))
    assert equal.count("within noise") == 4  # all columns
    content = json.loads(project_debug(tmp_path / "b.json", "--against", tmp_path / "a.json", "--json"))
    assert [pair["of"] for pair in content["rig_gap"]["differences"]] == ["b", "a", "a"]


def test_weights_without_rendered_streets_are_compared_by_rule(project_debug, tmp_path):
    text = project_debug(tmp_path / "a.json", "--model", "tiny", "--against", tmp_path / "b.json")
    assert "This is no measurement" in " ".join(text.split())
    assert "CAM_FRONT_LEFT looks 17° further down than any camera of nuScenes" in text
    assert "b: nothing differs" in text
    assert not (tmp_path / "out/rig_gap.png").exists()


def test_a_second_rig_with_errors_is_refused_by_its_name(project_debug, tmp_path):
    (tmp_path / "c.json").write_text("{}")
    with pytest.raises(InputError, match=r"c\.json: has no camera"):
        CliRunner().invoke(app, ["project-debug", f"{tmp_path}/a.json", f"--against={tmp_path}/c.json"], **LOUD)


def test_without_a_model_nothing_is_measured(project_debug, tmp_path):
    assert "Rig gap" not in project_debug(tmp_path / "a.json")
    assert "rig_gap" not in json.loads((tmp_path / "out/findings.json").read_text())


@pytest.mark.slow
def test_rendered_streets_are_measured_and_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(rig_gap, "STREETS", rig_gap.STREETS[:1])
    write_calibration(tmp_path / "a.json", tilted("CAM_FRONT_LEFT", -28.0))
    command = ["project-debug", str(tmp_path / "a.json"), "--model", "demo", "--out", str(tmp_path / "out")]
    first = CliRunner().invoke(app, command)
    assert "12/12 frames of rendered streets" in first.stderr
    kept = sorted((tmp_path / "cache/bevcli/rig-gap").iterdir())
    assert len(kept) == 3  # training rig, this rig, and this rig with a level camera
    again = CliRunner().invoke(app, command)
    assert again.stdout == first.stdout
    gap = json.loads((tmp_path / "out/findings.json").read_text())["rig_gap"]
    assert gap["rigs"]["a"]["found"] <= gap["rigs"]["training rig"]["found"]
