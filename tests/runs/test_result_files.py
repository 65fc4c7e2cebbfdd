"""Files of results: of models that plan, of the tracker, of a new type, boxes in images, and notes on all images."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from interrupted import run_frames
from memory_drive import MemoryDrive, WithoutImages

from bevcli.config import TRACKING, load_table
from bevcli.errors import ConfigError, InputError
from bevcli.frame import CameraImage, FrameResult, FrameStamp, Ground, GroundLines
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.inference import run
from bevcli.inference.load import Model
from bevcli.inference.runner import read_commands, with_command
from bevcli.inference.tracking import TrackerConfig, track
from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import ModelConfig
from bevcli.model.image_boxes import ImageBoxes
from bevcli.model.nanodet import NanoDet, NanoDetConfig
from bevcli.model.step import ModelOutputs
from bevcli.recording import RecordingOptions, entities
from bevcli.runs import RunOptions
from bevcli.runs.run_into_folder import run_in_folder, run_into_folder
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.sequences.files.incremental_json import GrowingFile
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop.formats.map_lines import LinesWriter, MapLines, read_lines
from bevcli.workshop.live import Session
from bevcli.workshop.vad.plan import Plan, read_plans
from bevcli.workshop.vad.vad import VAD
from bevcli.workshop.video import RecordedImages, draw_frame, tiles

FRAMES = 3


@pytest.fixture(scope="module")
def model(mini_vad: VAD) -> Model:
    return Model(mini_vad)


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
    assert (lines.frame_of_reference, lines.classes, len(plans)) == (
        "world",
        ("divider", "ped_crossing", "boundary"),
        FRAMES,
    )
    assert [planned.plan.command for planned in plans] == ["straight", "left", "left"]  # it stays until the next one
    files = lines.frames, plans, read_boxes(out / "predictions.json").frames
    for (frame, prediction), of_frame, planned, boxes in zip(run(model, MemoryDrive(FRAMES)), *files, strict=True):
        np.testing.assert_allclose(boxes.boxes.futures, prediction.boxes_world.futures, atol=1e-3)
        np.testing.assert_allclose(boxes.boxes.future_scores, prediction.boxes.future_scores)
        found, plan = prediction.results
        assert of_frame.stamp == planned.stamp == frame.stamp
        ego_from_world = np.linalg.inv(frame.world_from_ego.matrix)
        true, stored = (*found.points, *plan.paths), (*of_frame.lines.points, *planned.plan.paths)
        for points, written in zip(true, stored, strict=True):
            in_ego = written @ ego_from_world[:3, :3].T + ego_from_world[:3, 3]
            np.testing.assert_allclose(in_ego[:, 2], 0, atol=1e-3)
            forward = points @ prediction.ego_from_bev[:2, :2].T + prediction.ego_from_bev[:2, 3]
            np.testing.assert_allclose(in_ego[:, :2], forward, atol=2e-3)
        np.testing.assert_allclose(of_frame.lines.scores, found.scores)
        np.testing.assert_allclose(planned.plan.times_s, [0.5, 1, 1.5])


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
    drive = MemoryDrive(1)
    session, frame = Session(model, drive.rig, command="left"), drive.load(0)
    images = {name: image.pixels_bgr for name, image in frame.images.items()}
    with pytest.raises(InputError, match=r"`command=up` .*: is unknown"):
        session.step(images, frame.world_from_ego, 0, command="up")
    assert session.frame is None  # which is as it was
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
        ({"classes": "divider"}, "classes: expected `array`, got `str`"),
        ({"frames": [{"frame": 0}]}, "entry 0 of frames"),
        (
            {"frames": [{"frame": 0, "timestamp_ns": 0, "lines": [{"class": "a", "points": [[0, 0]]}]}]},
            r"lines\[0\].points: expected `array` of length >= 2",
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


RED = (255, 0, 0)


class StopLineFile(GrowingFile):
    """stop_lines.txt: the distance of the stop line, a frame a line."""

    def __init__(self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None) -> None:
        super().__init__(path, resume_at)

    def write(self, ground: Ground, result: StopLine | None) -> None:
        self.append(f"{ground.stamp.index} {None if result is None else result.ahead_m}\n".encode())


@dataclass(frozen=True)
class StopLine(FrameResult):
    """A line across the lane, so many metres ahead."""

    kind = "stop_line"
    file_name = "stop_lines.txt"
    writer = StopLineFile

    ahead_m: float

    @classmethod
    def legend(cls, names):
        return dict.fromkeys(names, RED)

    def drawn(self, ground, names, score):
        return GroundLines([ground.points(np.array([[-2.0, self.ahead_m], [2.0, self.ahead_m]]))], [(*RED, 255)], 2.0)


@dataclass(frozen=True)
class StoppingConfig(ModelConfig):
    @property
    def results(self):
        return {StopLine: ("stop line",)}


class Stopping(BEVFormer):
    def decode(self, outputs: ModelOutputs) -> Iterator[Any]:
        yield from super().decode(outputs)
        yield StopLine(10.0)


def test_a_new_result_has_a_file_a_drawing_and_a_legend(mini_config, tmp_path):
    settings = {field.name: getattr(mini_config, field.name) for field in fields(ModelConfig)}
    model = Model(Stopping(StoppingConfig(**settings)).eval())
    run_into_folder(model, MemoryDrive(2), tmp_path / "out")
    assert (tmp_path / "out/stop_lines.txt").read_text() == "0 10.0\n1 10.0\n"
    for frame in RecordingReader(tmp_path / "out/recording.rrd").frames():
        (line,) = frame.strips(f"{entities.BEV}/stop_line", "LineStrips2D:strips")
        np.testing.assert_allclose(line, [[-2, -10], [2, -10]], atol=1e-3)
        assert frame.texts(entities.RUN, "line_names")[0] == "stop line"
        from_above = draw_frame(frame, tiles(frame), RecordedImages())[:, 1280:].astype(int)
        assert (np.abs(from_above - RED[::-1]).max(-1) < 60).sum() > 10


IN_IMAGE = [32.5, 18.5, 160.5, 90.5]  # of the box in the images of 320 x 180, of which the network sees half
PERSON = np.array(NUSCENES_CLASSES["pedestrian"].color)


@pytest.fixture
def detecting_model(mini_config, monkeypatch) -> Model:
    """It sees a person of score 0.9 and a weak one of 0.1 in each image."""

    def seen(backbone, maps, has_image, sizes=None):
        boxes = torch.tensor([16.0, 9.0, 80.0, 45.0]).expand(*has_image.shape, 2, 4)
        scores = torch.tensor([0.9, 0.1]) * has_image[..., None]
        none = boxes[..., :0]
        return ImageBoxes(boxes, scores, torch.zeros(scores.shape, dtype=torch.int64), none, none, none)

    monkeypatch.setattr(NanoDet, "image_boxes", seen)
    return Model(BEVFormer(replace(mini_config, backbone=NanoDetConfig(output_stages=(1,)))).eval())


def test_a_prediction_has_the_boxes_of_each_camera(detecting_model, mini_model):
    [(_, prediction)] = run(detecting_model, MemoryDrive(1))
    assert list(prediction.image_boxes) == list(prediction.camera_embeddings)
    strong, weak = prediction.image_boxes["CAM_BACK"]
    assert (strong.class_name, strong.score, weak.score) == ("person", pytest.approx(0.9), pytest.approx(0.1))
    np.testing.assert_allclose(strong.corners, IN_IMAGE)
    [(_, without)] = run(Model(mini_model), MemoryDrive(1))
    assert without.image_boxes is None


def test_a_plot_shows_those_of_its_score(detecting_model):
    [(_, prediction)] = run(detecting_model, MemoryDrive(1))
    images = [replace(prediction, image_boxes=boxes).plot("CAM_FRONT") for boxes in (prediction.image_boxes, None)]
    rows, columns = np.nonzero((images[0] != images[1]).any(-1))
    np.testing.assert_allclose((columns.min(), rows.min(), columns.max(), rows.max()), IN_IMAGE, atol=2)
    without = replace(prediction, image_boxes=None)
    assert (prediction.plot("CAM_FRONT", score=0.95) == without.plot("CAM_FRONT", score=0.95)).all()


def test_a_run_writes_and_draws_them(detecting_model, mini_model, tmp_path):
    run_into_folder(detecting_model, WithoutImages({1: "all"}, count=2), tmp_path / "out")
    lines = (tmp_path / "out/image_boxes.csv").read_text().splitlines()
    assert lines[0] == "frame,scene,timestamp_ns,camera,class,score,x0,y0,x1,y1"
    assert lines[1] == "0,a,1000000000000000000,CAM_FRONT,person,0.9,32.5,18.5,160.5,90.5"
    assert len(lines) == 1 + 6 * 2
    entity = entities.overlay("CAM_BACK", "image_boxes")
    for frame, count in zip(RecordingReader(tmp_path / "out/recording.rrd").frames(), (1, 0), strict=True):
        strips = frame.strips(entity, "LineStrips2D:strips")
        assert len(strips) == count
        np.testing.assert_allclose([strip[[0, 2]].ravel() for strip in strips], [IN_IMAGE] * count)
        in_video = draw_frame(frame, tiles(frame), RecordedImages())[:500, :1280].astype(int)
        assert ((np.abs(in_video - PERSON[::-1]).max(-1) < 20).sum() > 100) == count
    run_into_folder(Model(mini_model), MemoryDrive(1), tmp_path / "other")
    assert not (tmp_path / "other/image_boxes.csv").exists()


MINIMAL = RunOptions(recording=RecordingOptions(level="minimal"))


def test_a_run_without_any_image_is_an_error(mini_model, tmp_path):
    drive = WithoutImages({0: "all", 1: "all"}, count=2)
    with pytest.raises(InputError, match=r"memory: not one image could be read \(camera CAM_FRONT: missing\)"):
        run_into_folder(Model(mini_model), drive, tmp_path / "none", MINIMAL)
    assert list(tmp_path.iterdir()) == []  # what would stand in the way of the corrected command
    with_one = run_into_folder(Model(mini_model), WithoutImages({0: "all"}, count=2), tmp_path / "none", MINIMAL)
    assert with_one.counts.skipped == [0]


class BreaksOff(MemoryDrive):
    """The second frame cannot be read."""

    broken = 1

    def load(self, place):
        if place == self.broken:
            raise InputError("an image has another size")
        return super().load(place)


@pytest.mark.parametrize("broken", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_run_that_fails_at_once_leaves_nothing(mini_model, tmp_path, broken):
    """Beside what was in the folder before. With a frame, there is something to resume."""
    (tmp_path / "before").mkdir()
    drive = BreaksOff(3)
    drive.broken = broken
    for name in ("new", "before"):
        with pytest.raises(InputError, match="another size"):
            run_into_folder(Model(mini_model), drive, tmp_path / name, MINIMAL)
        assert (tmp_path / name / "summary.json").exists() == (broken == 1)
    assert broken == 1 or list(tmp_path.iterdir()) == [tmp_path / "before"]
    run_into_folder(Model(mini_model), MemoryDrive(3), tmp_path / "before", MINIMAL, resume=broken == 1)


class TwelveBitsInSixteen(MemoryDrive):
    """The images of one camera have 12 bits that are stored in 16, of which a reader keeps the upper 8."""

    def load(self, place):
        frame = super().load(place)
        image = frame.images["CAM_BACK"]
        dark = CameraImage(image.timestamp_ns, (image.pixels_bgr.astype(np.uint16) * 16 // 256).astype(np.uint8))
        return replace(frame, images={**frame.images, "CAM_BACK": dark})


def test_images_that_are_black_throughout_are_said(mini_model, tmp_path):
    summary = run_into_folder(Model(mini_model), TwelveBitsInSixteen(2), tmp_path, MINIMAL)
    said = "all images of CAM_BACK are nearly black or white"
    assert said in summary.table()
    assert any(said in note for note in json.loads((tmp_path / "summary.json").read_text())["notes"])


# The mini model is untrained: its scores and places mean nothing, so every box may start a track.
EAGER = TrackerConfig(birth_score=0.0, keep_score=0.0)
TRACK_COLUMNS = ("instances", "track_scores", "duplicates")


@pytest.fixture
def tracked_model(mini_model):
    return Model(mini_model, tracker=EAGER)


def predictions(tracked_model, sequence, **options):
    return [prediction for _, prediction in run(tracked_model, sequence, **options)]


def test_the_tracker_changes_no_number(tracked_model):
    with_tracks = predictions(tracked_model, MemoryDrive(3))
    without = predictions(tracked_model, MemoryDrive(3), track=False)
    for one, other in zip(with_tracks, without, strict=True):
        for column in fields(Boxes3D):
            if column.name in TRACK_COLUMNS:
                assert getattr(other.boxes, column.name) is None
                assert len(getattr(one.boxes, column.name)) == len(one.boxes)
            else:
                assert np.array_equal(getattr(one.boxes, column.name), getattr(other.boxes, column.name))


def test_identities_reach_boxes_of_every_frame_of_reference(tracked_model):
    prediction = predictions(tracked_model, MemoryDrive(1))[0]
    assert (prediction.boxes.instances != "").any()
    for boxes in (prediction.boxes_ego, prediction.boxes_world):
        assert list(boxes.instances) == list(prediction.boxes.instances)


def tracked(results, state=None):
    """State and prediction after each frame of a run."""
    for _, prediction in results:
        state, prediction = track(EAGER, state, prediction)
        yield state, prediction


def test_a_frame_without_images_leaves_the_tracks_alone(tracked_model):
    states = [state for state, _ in tracked(run(tracked_model, WithoutImages({1: "all"}, count=3), track=False))]
    assert states[1] is states[0]
    assert states[2].stamp.index == 2


def test_predictions_and_tracks_files_hold_the_identities(tracked_model, tmp_path):
    options = RunOptions(recording=RecordingOptions("minimal", score=0.0))
    with run_in_folder(tracked_model, MemoryDrive(3), tmp_path, options) as running:
        seen = [prediction for _, prediction in running.frames]
    frames = read_boxes(tmp_path / "predictions.json").frames
    for frame, prediction in zip(frames, seen, strict=True):
        assert list(frame.boxes.instances) == list(prediction.boxes.instances)
        assert np.array_equal(frame.boxes.track_scores, prediction.boxes.track_scores, equal_nan=True)
        duplicates = frame.boxes.duplicates  # the file states them only where there are any
        assert list(prediction.boxes.duplicates) == [False] * 20 if duplicates is None else list(duplicates)
    with (tmp_path / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = [(frame, box) for frame in frames for box in np.flatnonzero(frame.boxes.instances != "")]
    assert len(rows) == len(expected) > 0
    for row, (frame, box) in zip(rows, expected, strict=True):
        boxes = frame.boxes
        assert (row["frame"], row["instance"]) == (str(frame.stamp.index), boxes.instances[box])
        assert (row["class"], row["frame_of_reference"]) == (boxes.classes[box], "world")
        assert float(row["track_score"]) == boxes.track_scores[box]
        assert [float(row[key]) for key in ("x", "y", "z")] == list(boxes.centers[box])
    instances = {name for frame in frames for name in frame.boxes.instances if name}
    assert json.loads((tmp_path / "summary.json").read_text())["tracks"] == len(instances)


def test_a_run_without_tracks_writes_none(tracked_model, tmp_path):
    options = RunOptions(track=False, recording=RecordingOptions("minimal"))
    summary = run_into_folder(tracked_model, MemoryDrive(2), tmp_path, options)
    assert not (tmp_path / "tracks.csv").exists()
    assert all(frame.boxes.instances is None for frame in read_boxes(tmp_path / "predictions.json").frames)
    assert summary.to_dict()["tracks"] is None
    assert "\ntracks " not in summary.table()


def test_the_models_file_holds_the_parameters(tmp_path):
    assert load_table("tiny", TRACKING, TrackerConfig) == TrackerConfig()
    assert load_table("demo", TRACKING, TrackerConfig) != TrackerConfig()
    file = tmp_path / "mine.toml"
    file.write_text("[tracking]\nbirth_score = 0.5\n[tracking.gates_m]\ncar = 7\n")
    own = load_table(file, TRACKING, TrackerConfig)
    assert own == replace(TrackerConfig(), birth_score=0.5, gates_m={"car": 7.0})
    file.write_text("[tracking]\nbirth = 0.5\n")
    with pytest.raises(ConfigError, match=r'unknown key "tracking\.birth"; did you mean "birth_score"'):
        load_table(file, TRACKING, TrackerConfig)
    file.write_text("[tracking]\nbirth_score = 0.1\nkeep_score = 0.2\n")
    with pytest.raises(ConfigError, match=r"\[tracking\]: keep_score must not be above birth_score"):
        load_table(file, TRACKING, TrackerConfig)
