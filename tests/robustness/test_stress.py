"""Sequences with lost images, wrong calibration, times or ego-motion, and `bevcli stress`."""

import json
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from command_line import invoked
from made_boxes import made_boxes
from memory_drive import MemoryDrive

from bevcli.errors import InputError, OutputError
from bevcli.frame import Frame
from bevcli.geometry.cameras import Distortion, camera_pose_noise
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose, apply, inverse
from bevcli.inference import run
from bevcli.inference.load import Model
from bevcli.inference.runner import Runner
from bevcli.workshop.calibration.views import motion_during
from bevcli.workshop.robustness.conditions import (
    NAMES,
    BodyPitch,
    CalibrationNoise,
    CameraCrash,
    Draws,
    EgoMotionLost,
    FrameLost,
    TimeOffsets,
    _turned,
    at_lower_rate,
    choose_conditions,
)
from bevcli.workshop.robustness.stress import (
    ConditionScores,
    StressOptions,
    StressResults,
    StressTest,
    read_results,
    split_scenes,
    stress,
    stress_table,
)
from bevcli.workshop.synth.drives import FrameMemory, KeptFrames
from bevcli.workshop.synth.rig import nuscenes_like_rig, tilt
from bevcli.workshop.training.validation import drives_table, score_drives

FRAMES = 3
TRIED = ("clean", "frame_lost", "snow", "calibration_noise", "ego_motion_lost", "frame_rate")
CONDITIONS = [each for each in choose_conditions() if each.severity in ("", "hard", "4") and each.name in TRIED]


class SelfLabelledDrive(MemoryDrive):
    """The noise drive; its ground truth is what the model finds in the clean images, so that scores are high."""

    def __init__(self, model: Model, name: str = "memory") -> None:
        super().__init__(FRAMES)
        self.name = name
        self.truth = [p.boxes_world[:6] for _, p in run(model, MemoryDrive(FRAMES), track=False)]

    def load(self, index: int) -> Frame:
        return replace(super().load(index), ground_truth=self.truth[index])


class DrivesInMemory(list):
    """A list of drives as `Drives`."""

    input_shapes = None

    def open(self, index):
        return self[index]


@pytest.fixture(scope="module")
def model(mini_model) -> Model:
    return Model(mini_model)


@pytest.fixture(scope="module")
def drives(model):
    return [SelfLabelledDrive(model), SelfLabelledDrive(model, "second")]


@pytest.fixture(scope="module")
def whole(model, drives, tmp_path_factory) -> Path:
    """The folder of an uninterrupted test."""
    out = tmp_path_factory.mktemp("stress") / "whole"
    results = stress(model, drives, CONDITIONS, out)
    assert results.is_complete
    return out


def content(out: Path) -> dict:
    return json.loads((out / "stress.json").read_text())


def test_every_condition_is_scored_and_changes_the_predictions(whole):
    scores = {each["corruption"]: each for each in content(whole)["conditions"]}
    assert tuple(scores) == TRIED
    assert scores["clean"]["mean_ap"] > 0.5
    assert len({(each["nd_score"], each["mean_ap"]) for each in scores.values()}) == len(TRIED)
    assert content(whole)["complete"]
    assert {path.name for path in whole.iterdir()} == {".bevcli", "stress.json"}
    assert not list((whole / ".bevcli").glob("boxes*"))


def test_the_clean_scores_are_those_of_validate(whole, model, drives):
    together = score_drives(Runner(model.prepared, model.device), DrivesInMemory(drives), each_drive=True)
    summary = together.summary()
    assert content(whole)["conditions"][0]["nd_score"] == pytest.approx(summary["NDS"], abs=1e-9)
    second = score_drives(Runner(model.prepared, model.device), DrivesInMemory(drives[1:])).summary()
    assert [(drive.name, drive.cameras) for drive in together.drives] == [("memory", 6), ("second", 6)]
    assert (together.drives[1].mean_ap, together.drives[1].nd_score) == (second["mAP"], second["NDS"])
    assert drives_table(together.drives).splitlines()[-1].startswith("mAP: mean 0.")


@pytest.mark.slow
def test_an_interrupted_test_resumed_gives_the_same_bytes(whole, model, drives, tmp_path):
    out, runs, is_complete = tmp_path / "out", 0, False
    while runs < 50 and not is_complete:
        test, runs = StressTest(model, drives, CONDITIONS, out, resume=True), runs + 1
        known = content(out)["conditions"] if out.exists() else []
        found = list(islice(test.run(), 9))  # as an early end of the loop
        assert not known or found[0] >= FRAMES  # finished scenes are not run again
        is_complete = test.results.is_complete
        assert content(out)["complete"] is is_complete
    assert runs > 3
    assert (out / "stress.json").read_bytes() == (whole / "stress.json").read_bytes()


@pytest.mark.slow
def test_a_resumed_test_may_get_more_conditions_no_other_options(whole, model, drives, tmp_path):
    for part in (CONDITIONS[3:4], CONDITIONS):
        stress(model, drives, part, tmp_path, resume=True)
    assert (tmp_path / "stress.json").read_bytes() == (whole / "stress.json").read_bytes()
    with pytest.raises(OutputError, match="option seed: was 0, is 1"):
        stress(model, drives, CONDITIONS, tmp_path, StressOptions(seed=1), resume=True)
    with pytest.raises(OutputError, match="`force=True`"):
        stress(model, drives, CONDITIONS, tmp_path)


@pytest.mark.slow
def test_another_seed_gives_other_scores(model, drives, tmp_path):
    part = [each for each in CONDITIONS if each.name in ("clean", "calibration_noise")]
    scores = []
    for seed in (0, 1):
        results = stress(model, drives, part, tmp_path / str(seed), StressOptions(seed=seed))
        scores.append([each.nd_score for each in results.scores])
    assert scores[0][0] == scores[1][0]
    assert scores[0][1] != scores[1][1]


def test_drives_and_conditions_that_cannot_be_are_refused(model, tmp_path):
    with pytest.raises(InputError, match="memory: has no ground truth"):
        stress(model, [MemoryDrive(2)], CONDITIONS[:1], tmp_path)
    with pytest.raises(InputError, match=r"rain.*camera_crash.*snow"):
        choose_conditions("all", ["rain"])
    for options in ([], ["samples/crossing", "--rendered", "1000000:1000001"]):
        with pytest.raises(InputError, match="SEQUENCE folders or --rendered SEEDS"):
            invoked("stress", *options)


# NDS as published, each the mean over three severities: clean, then camera crash, frame lost, colour quantisation,
# motion blur, brightness, low light, fog, snow.
BEVFORMER_BASE = (0.5174, 0.3154, 0.3017, 0.3509, 0.2695, 0.4184, 0.2515, 0.4069, 0.1857)
DETR3D = (0.4224, 0.2859, 0.2604, 0.3177, 0.2661, 0.4002, 0.2786, 0.3912, 0.1913)


def results(nds: tuple[float, ...], model: str = "base") -> StressResults:
    """Three severities whose mean is the published one."""
    scores = [ConditionScores("clean", "", nds[0], 0.4, {"trans_err": 0.5}, {"car": 0.6})]
    for name, value in zip(NAMES, nds[1:], strict=False):
        for severity, offset in (("easy", 0.05), ("mid", 0.01), ("hard", -0.06)):
            scores.append(ConditionScores(name, severity, value + offset, 0.2, {"vel_err": float("nan")}, {"car": 0.3}))
    return StressResults({"model": model, "drives": []}, tuple(scores))


def test_means_of_bevformer_base_are_the_published_ones():
    own, other = results(BEVFORMER_BASE), results(DETR3D)
    assert 100 * own.mean_resilience() == pytest.approx(60.40, abs=0.01)
    assert 100 * other.mean_resilience() == pytest.approx(70.77, abs=0.01)
    assert 100 * own.mean_corruption_error(other) == pytest.approx(97.97, abs=0.01)
    assert own.mean_corruption_error(own) == 1
    assert own.differences(other) == ()
    assert own.differences(StressResults({**other.header, "seed": 3}, other.scores)) == ("seed",)


def test_stress_json_is_read_back(tmp_path):
    written = results(BEVFORMER_BASE)
    path = tmp_path / "stress.json"
    path.write_text(json.dumps(written.to_dict()))
    read = read_results(path)
    assert read.mean_resilience() == written.mean_resilience()
    assert json.dumps(read.to_dict()["conditions"]) == json.dumps(written.to_dict()["conditions"])


@pytest.mark.parametrize("content", ["{}", "[]", '{"format": "bevcli-stress/1", "conditions": [{"mean_ap": 0.1}]}'])
def test_another_file_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "stress.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"stress\.json"):
        read_results(path)


def test_the_table_has_a_row_per_corruption_and_the_means():
    table = stress_table(results(BEVFORMER_BASE), results(DETR3D, "detr3d"))
    for name in NAMES[:8]:
        assert f"\n{name} " in table
    assert "mRR 60.4 % over 8 of RoboBEV's 8 corruptions" in table
    assert "mCE 98.0 % against detr3d over 8 of RoboBEV's 8 corruptions" in table


def test_conditions_are_clean_and_each_corruption_by_severity():
    everything = choose_conditions()
    assert len(everything) == 1 + 8 * 3 + 5 * 3 + 4 + 4 * 3
    assert everything[0].name == "clean"
    easy = choose_conditions("easy", ["fog", "calibration_noise"])
    assert [(each.name, each.severity) for each in easy] == [("clean", ""), ("fog", "easy"), ("calibration_noise", "1")]


def test_the_levels_are_the_published_ones():
    levels = {each.name: [] for each in choose_conditions()}
    for each in choose_conditions()[1:]:
        levels[each.name].append(each.corruption.levels[each.severity])
    for name in ("camera_crash", "frame_lost", "motion_blur", "brightness", "fog"):
        assert levels[name] == [2, 4, 5]
    assert levels["color_quantisation"] == levels["snow"] == [1, 2, 3]
    assert levels["low_light"] == [2, 3, 4]
    assert levels["calibration_noise"] == [1, 2, 3, 4]


DRAWS = Draws(0, "test")


class WithTruth(MemoryDrive):
    """The noise drive with a parked car, in the world frame; counts how often a frame is read."""

    loads = 0

    def load(self, index: int) -> Frame:
        self.loads += 1
        car = made_boxes([(9.0, 2.0, 0.8)], sizes_lwh=(4.5, 2.0, 1.6), yaws=0.3, velocities=(0.4, 0.1))
        return replace(super().load(index), ground_truth=car)


def lost_cameras(frame: Frame) -> set[str]:
    return {name for name, image in frame.images.items() if not image.pixels_bgr.any()}


def test_a_crashed_camera_is_black_in_each_frame_also_at_harder():
    drive = MemoryDrive(3)
    lost = {}
    for level in (2, 4, 5):
        frames = [CameraCrash(drive, level, DRAWS, "black").load(place) for place in range(3)]
        each = [lost_cameras(frame) for frame in frames]
        assert each[0] == each[1] == each[2]
        assert 1 <= len(each[0]) <= level
        assert all(set(frame.images) == set(drive.rig.names) for frame in frames)
        lost[level] = each[0]
    assert lost[2] <= lost[4] <= lost[5]
    # Drawn with replacement, so that scenes may lose fewer.
    counts = {len(CameraCrash(drive, 2, Draws(seed, "test"), "black").lost(drive.load(0))) for seed in range(30)}
    assert counts == {1, 2}


def test_a_missing_image_is_left_out_and_reported():
    drive = MemoryDrive(1)
    black, missing = (CameraCrash(drive, 4, DRAWS, kind).load(0) for kind in ("black", "missing"))
    assert set(missing.dropped) == lost_cameras(black) == set(drive.rig.names) - set(missing.images)


@pytest.mark.parametrize("level", [2, 4, 5])
def test_frame_lost_loses_a_share_of_level_sixths(level):
    drive = MemoryDrive(1)
    frame, sequence = drive.load(0), FrameLost(drive, level, DRAWS, "black")
    frames = [replace(frame, stamp=replace(frame.stamp, index=index)) for index in range(400)]
    lost = sum(len(sequence.lost(each)) for each in frames)
    assert lost / 2400 == pytest.approx(level / 6, abs=0.03)


def test_calibration_noise_has_the_stated_spread_per_axis():
    level = 4
    noise = [camera_pose_noise(level, Draws(seed, "test").generator()) for seed in range(2000)]
    translations = np.array([each[:3, 3] for each in noise])
    # For small angles, the rotation about each axis is in the skew-symmetric part.
    skew = np.array([(each[:3, :3] - each[:3, :3].T) / 2 for each in noise])
    angles_deg = np.degrees(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1))
    assert translations.std(axis=0) == pytest.approx(0.20, rel=0.06)
    assert angles_deg.var(axis=0) == pytest.approx(4.0, rel=0.1)


def test_calibration_noise_is_one_wrong_rig_a_scene_and_no_more():
    drive = MemoryDrive(4, scenes="aabb")
    noisy = CalibrationNoise(drive, 2, DRAWS)
    frames = [noisy.load(place) for place in range(4)]
    assert frames[0].rig is frames[1].rig  # so that maps of the lens are made once
    poses = [frame.rig["CAM_FRONT"].ego_from_camera for frame in frames]
    assert np.array_equal(poses[2], poses[3])
    assert not np.allclose(poses[1], poses[2], atol=1e-4)
    clean = drive.load(0)
    assert np.array_equal(frames[0].rig.ego_from_bev, clean.rig.ego_from_bev)
    assert np.array_equal(frames[0].images["CAM_BACK"].pixels_bgr, clean.images["CAM_BACK"].pixels_bgr)
    assert np.array_equal(frames[0].rig["CAM_BACK"].intrinsics, clean.rig["CAM_BACK"].intrinsics)


def test_a_wrong_capture_time_moves_the_camera_along_the_path():
    drive = MemoryDrive(2)
    clean, wrong = drive.load(1), TimeOffsets(drive, 200, DRAWS).load(1)
    offsets = {name: wrong.images[name].timestamp_ns - clean.images[name].timestamp_ns for name in drive.rig.names}
    assert len(set(offsets.values())) == 6
    assert max(map(abs, offsets.values())) <= 200_000_000
    for name, offset_ns in offsets.items():
        moved = inverse(clean.world_from_ego.matrix) @ wrong.world_from_ego_at[name].matrix
        assert moved[0, 3] == pytest.approx(6.0 * offset_ns / 1e9, abs=0.01)  # the drive has 6 m/s and 0.1 rad/s
        assert np.arctan2(moved[1, 0], moved[0, 0]) == pytest.approx(0.1 * offset_ns / 1e9, abs=1e-6)
    assert np.array_equal(wrong.world_from_ego.matrix, clean.world_from_ego.matrix)


def test_the_motion_during_a_time_is_that_of_many_short_steps():
    kinematics = Kinematics(np.zeros(3), np.array([0.02, -0.05, 0.6]), np.array([8.0, 0.3, 0.1]))
    steps = np.eye(4)
    for _ in range(1000):
        steps = steps @ motion_during(0.2 / 1000, kinematics)
    whole = motion_during(0.2, kinematics)
    assert np.abs(whole - steps).max() < 0.003
    assert np.allclose(whole @ motion_during(-0.2, kinematics), np.eye(4), atol=0.003)


def test_a_lost_pose_is_the_last_that_arrived_and_truth_stays():
    drive = WithTruth(10)
    stale = EgoMotionLost(drive, 4, DRAWS)
    clean, frames = [drive.load(place) for place in range(10)], [stale.load(place) for place in range(10)]
    poses = [frame.world_from_ego for frame in frames]
    assert np.array_equal(poses[0].matrix, clean[0].world_from_ego.matrix)
    held = 0
    for place in range(1, 10):
        own, last = clean[place].world_from_ego.matrix, poses[place - 1].matrix
        arrived = np.array_equal(poses[place].matrix, own)
        assert arrived or np.array_equal(poses[place].matrix, last)
        held += not arrived
        truths = [_in_ego(frame) for frame in (clean[place], frames[place])]
        assert truths[0] == pytest.approx(truths[1], abs=1e-9)
    assert 3 <= held <= 9
    backwards = [EgoMotionLost(drive, 4, DRAWS).load(place).world_from_ego.matrix for place in range(10)]
    assert np.array_equal([pose.matrix for pose in poses], backwards)
    drive = MemoryDrive(10, scenes="ababababab")  # the first frame of a scene keeps its pose
    stale = EgoMotionLost(drive, 5, DRAWS)
    assert all(np.array_equal(stale.load(k).world_from_ego.matrix, drive.pose(k).matrix) for k in range(10))


def _in_ego(frame: Frame) -> np.ndarray:
    assert frame.ground_truth is not None
    return frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix)).to_numpy()


@pytest.mark.parametrize("step", [2, 3, 4])
def test_a_lower_rate_has_every_frame_once(step):
    parts = at_lower_rate(MemoryDrive(9), step)
    indices = [[stamp.index for stamp in part.stamps] for part in parts]
    assert sorted(index for part in indices for index in part) == list(range(9))
    assert all(later - earlier == step for part in indices for earlier, later in pairwise(part))
    scenes = split_scenes(MemoryDrive(5, scenes="aabbb"))  # which are run one by one
    assert [[stamp.scene for stamp in scene.stamps] for scene in scenes] == [["a", "a"], ["b", "b", "b"]]


def test_kept_frames_are_read_once_while_the_memory_lasts():
    drive = WithTruth(3)
    frame_bytes = sum(image.pixels_bgr.nbytes for image in drive.load(0).images.values())
    drive.loads = 0
    kept = KeptFrames(drive, FrameMemory(2 * frame_bytes), 0)
    for _ in range(3):
        for place in range(3):
            kept.load(place)
    assert drive.loads == 2 + 3
    assert isinstance(kept.load(0).world_from_ego, Pose)


@pytest.mark.parametrize("lens", [None, Distortion("brown_conrady", (-0.2, 0.05, 0.001, 0.0))])
def test_a_pitching_body_turns_images_about_their_cameras(lens):
    """A point that is far away is seen where the camera of a pitched vehicle sees it; poses and rig stay."""
    front = replace(nuscenes_like_rig(320, 180)["CAM_FRONT"], distortion=lens)
    far = apply(front.ego_from_camera, front.rays([[200.0, 80.0]]) * 1e4)
    pixels = np.zeros((180, 320, 3), np.uint8)
    pixels[79:82, 199:202] = 255
    turned = _turned(pixels, front, tilt(np.radians(2.0), np.radians(-1.0)))
    expected, _ = front.project_ego(far @ tilt(np.radians(2.0), np.radians(-1.0)))  # level_from_body.T @ point
    weights = turned[..., 0] / turned[..., 0].sum()
    found = [(weights * grid).sum() for grid in np.indices((180, 320))[::-1]]
    assert found == pytest.approx(expected[0].tolist(), abs=0.1)
    assert expected[0, 1] < 75  # the nose goes down, so what is ahead goes up in the image


def test_a_body_pitches_anew_in_each_frame_and_more_at_harder():
    drive = MemoryDrive(2)
    clean, frames = drive.load(0), {}
    for level in (1, 3):
        frames[level] = [BodyPitch(drive, level, DRAWS).load(place) for place in range(2)]
        assert frames[level][0].rig is clean.rig
        assert np.array_equal(frames[level][0].world_from_ego.matrix, clean.world_from_ego.matrix)
    before, after = (each.images["CAM_FRONT"].pixels_bgr for each in (clean, frames[1][0]))
    assert not np.array_equal(before, after)
    draws = [BodyPitch(drive, 1, DRAWS).random(drive.stamps[k], k).standard_normal(2) for k in range(2)]
    assert not np.allclose(draws[0], draws[1])
