"""map_lines.json, plan.csv and futures: a run of a model that plans writes them, and we read them back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from interrupted import run_frames
from memory_drive import MemoryDrive

from bevcli.errors import InputError
from bevcli.frame import FrameStamp, Ground
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.inference.load import Model
from bevcli.inference.run import Session, run
from bevcli.inference.runner import read_commands, with_command
from bevcli.model.config import ModelConfig
from bevcli.recording.options import RecordingOptions
from bevcli.runs.options import RunOptions
from bevcli.runs.run_into_folder import run_into_folder
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.workshop.formats.map_lines import LinesWriter, MapLines, read_lines
from bevcli.workshop.vad.heads import LineDecoderConfig, MotionConfig
from bevcli.workshop.vad.plan import Plan, read_plans
from bevcli.workshop.vad.vad import VAD, VADConfig

FRAMES = 3
MOTION = MotionConfig(modes=2, steps=3, step_s=0.5, attention_heads=4, feed_forward_width=32)
LINES = LineDecoderConfig(
    lines=6, line_points=5, layers=1, attention_heads=4, feed_forward_width=32, max_lines=4, classes=("divider", "kerb")
)


@pytest.fixture(scope="module")
def model(mini_config: ModelConfig) -> Model:
    settings = {field.name: getattr(mini_config, field.name) for field in fields(mini_config)}
    torch.manual_seed(0)
    return Model(VAD(VADConfig(**settings | {"name": "mini-vad"}, line_decoder=LINES, motion=MOTION)).eval())


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> RunOptions:
    file = tmp_path_factory.mktemp("commands") / "commands.json"
    file.write_text('{"1": "left", "0": "straight"}')
    return RunOptions(command=str(file), recording=RecordingOptions(level="minimal"))


@pytest.fixture(scope="module")
def out(model: Model, options: RunOptions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("planned") / "out"
    run_into_folder(model, MemoryDrive(FRAMES), folder, options)
    return folder


def test_files_hold_the_results_on_the_ground(model: Model, out: Path) -> None:
    lines, plans = read_lines(out / "map_lines.json"), read_plans(out / "plan.csv")
    assert (lines.frame_of_reference, lines.classes, len(plans)) == ("world", ("divider", "kerb"), FRAMES)
    for (frame, prediction), of_frame, planned in zip(
        run(model, MemoryDrive(FRAMES)), lines.frames, plans, strict=True
    ):
        found, plan = prediction.results
        assert of_frame.stamp == planned.stamp == frame.stamp
        ego_from_world = np.linalg.inv(frame.world_from_ego.matrix)
        for points, written in zip(
            (*found.points, *plan.paths), (*of_frame.lines.points, *planned.plan.paths), strict=True
        ):
            in_ego = written @ ego_from_world[:3, :3].T + ego_from_world[:3, 3]
            np.testing.assert_allclose(in_ego[:, 2], 0, atol=1e-3)
            forward = points @ prediction.ego_from_bev[:2, :2].T + prediction.ego_from_bev[:2, 3]
            np.testing.assert_allclose(in_ego[:, :2], forward, atol=2e-3)
        np.testing.assert_allclose(of_frame.lines.scores, found.scores)
        np.testing.assert_allclose(planned.plan.times_s, [0.5, 1, 1.5])


def test_a_command_stays_until_the_next_one(out: Path) -> None:
    assert [planned.plan.command for planned in read_plans(out / "plan.csv")] == ["straight", "left", "left"]


def test_futures_are_read_back_in_the_world_frame(model: Model, out: Path) -> None:
    written = read_boxes(out / "predictions.json").frames
    for (_, prediction), frame in zip(run(model, MemoryDrive(FRAMES)), written, strict=True):
        np.testing.assert_allclose(frame.boxes.futures, prediction.boxes_world.futures, atol=1e-3)
        np.testing.assert_allclose(frame.boxes.future_scores, prediction.boxes.future_scores)


def test_an_interrupted_run_goes_on_with_all_files(
    model: Model, options: RunOptions, out: Path, tmp_path: Path
) -> None:
    stopped = tmp_path / "out"
    run_frames(1, model, MemoryDrive(FRAMES), stopped, options)
    run_into_folder(model, MemoryDrive(FRAMES), stopped, options, resume=True)
    for name in ("map_lines.json", "plan.csv", "predictions.json"):
        assert (stopped / name).read_bytes() == (out / name).read_bytes()


def test_wrong_commands_are_refused(model: Model, mini_config: ModelConfig, tmp_path: Path) -> None:
    file = tmp_path / "commands.json"
    file.write_text('{"0": "back"}')
    for command, message in ((str(file), '"0": .*expected right, left, straight'), ("back", "is unknown")):
        with pytest.raises(InputError, match=message):
            read_commands(command, model.config)
    with pytest.raises(InputError, match="mini plans no path"):
        read_commands("left", mini_config)
    plan = Plan(("left",), np.zeros((1, 1, 2)), np.ones(1))
    assert with_command((plan,), ((4, "left"),), 3)[0].command == ""


def test_points_lie_on_the_ground_below_the_bev_frame() -> None:
    pose = Pose.from_matrix(rigid([10.0, 20.0, 5.0], rotation_about_z(np.pi / 2)))
    ground = Ground(FrameStamp(0, "", 0), rigid([1.0, 0.0, 1.84]), pose)
    np.testing.assert_allclose(ground.points(np.array([2.0, 1.0])), [9.0, 23.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(replace(ground, world_from_ego=None).points(np.array([[2.0, 1.0]])), [[3.0, 1.0, 0.0]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "bevcli-map-lines/2"}, "is not a file of map lines"),
        ({"classes": "divider"}, '"classes" must be a list of names'),
        ({"frames": [{"frame": 0}]}, "entry 0 of frames"),
        (
            {"frames": [{"frame": 0, "timestamp_ns": 0, "lines": [{"class": "a", "points": [[0, 0]]}]}]},
            "line 0: points",
        ),
    ],
)
def test_wrong_files_of_lines_are_refused(change: dict, message: str, tmp_path: Path) -> None:
    path = tmp_path / "map_lines.json"
    writer = LinesWriter(path, "ego", {"classes": ["divider"]})
    writer.write(Ground(FrameStamp(0, "", 0), np.eye(4), None), MapLines((np.eye(2),), np.array(["divider"])))
    writer.close()
    assert len(read_lines(path).frames[0].lines) == 1
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=message):
        read_lines(path)


def test_a_session_takes_commands_as_a_run_does(model: Model, options: RunOptions, out: Path) -> None:
    drive = MemoryDrive(FRAMES)
    ways = {"file": (options.command, {}), "steps": (None, {0: "straight", 1: "left"})}
    plans = {way: list(_session_plans(model, drive, *given)) for way, given in ways.items()}
    for (_, prediction), *others in zip(run(model, drive, command=options.command), *plans.values(), strict=True):
        (expected,) = (result for result in prediction.results if isinstance(result, Plan))
        for plan in others:
            assert plan.command == expected.command
            assert plan.paths.tobytes() == expected.paths.tobytes()


def _session_plans(model: Model, drive: MemoryDrive, first: str | None, later: dict[int, str]) -> Iterator[Plan]:
    session = Session(model, drive.rig, command=first)
    for place in range(FRAMES):
        frame = drive.load(place)
        prediction = session.step(
            {name: image.pixels_bgr for name, image in frame.images.items()},
            frame.world_from_ego,
            frame.stamp.timestamp_ns,
            world_from_ego_at=frame.world_from_ego_at,
            kinematics=frame.kinematics,
            command=later.get(place),
        )
        (plan,) = (result for result in prediction.results if isinstance(result, Plan))
        yield plan


def test_a_wrong_command_leaves_a_session_as_it_was(model: Model) -> None:
    drive = MemoryDrive(1)
    session, frame = Session(model, drive.rig, command="left"), drive.load(0)
    images = {name: image.pixels_bgr for name, image in frame.images.items()}
    with pytest.raises(InputError, match=r"`command=up` .*: is unknown"):
        session.step(images, frame.world_from_ego, 0, command="up")
    assert session.frame is None
    with pytest.raises(InputError, match=r"`command=up` .*: is unknown"):
        Session(model, drive.rig, command="up")
