"""Agreement of boxes with a second witness: on rectangles that are projected by hand, and through the commands."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import MINI_TOML
from typer.testing import CliRunner

import bevcli
from bevcli.cli.main import app
from bevcli.errors import InputError
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.boxes import Boxes2D, Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.boxes_table import IMAGE_COLUMNS, ImageBoxesWriter
from bevcli.workshop.trust import estimate
from bevcli.workshop.trust.agreement import Agreement, agreement, compared, kept
from bevcli.workshop.trust.sightings import projected, sightings, unexplained
from bevcli.workshop.trust.witness import load_witness, seen_in_run

STREET = Path(__file__).parents[2] / "samples" / "street"
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # 1.5 m high, looks along x
CAMERA = Camera("front", 1000, 600, np.array([[500.0, 0, 500], [0, 500, 300], [0, 0, 1]]), AHEAD)
STANDS = Pose(np.zeros(3), np.array([1.0, 0, 0, 0]))
NUMBERS = {"pedestrian": (0.6, 0.6, 1.8), "car": (4.0, 1.8, 1.5), "bicycle": (1.8, 0.6, 1.2)}


def boxes(*rows: tuple[str, float, float], score: float = 0.8, speed: float = 0.0) -> Boxes3D:
    """Boxes on the ground. rows: class, x and y; metres."""
    names = np.array([row[0] for row in rows], dtype=str)
    sizes = np.array([NUMBERS[name] for name in names.tolist()]).reshape(-1, 3)
    centers = np.array([[x, y, NUMBERS[name][2] / 2] for name, x, y in rows]).reshape(-1, 3)
    count = len(rows)
    velocities = np.tile([speed, 0.0], (count, 1))
    return Boxes3D(centers, sizes, np.zeros(count), velocities, names, scores=np.full(count, score))


def frame(index: int = 0, step_s: float = 0.5) -> Frame:
    stamp = FrameStamp(index, "", round(index * step_s * 1e9))
    rig = CameraRig((CAMERA,), default_ego_from_bev())
    return SimpleNamespace(stamp=stamp, rig=rig, world_from_ego=STANDS, world_from_ego_at={"front": STANDS})


COCO = {"pedestrian": "person", "car": "car", "bicycle": "bicycle"}


def seen(of: Boxes3D, right_px: float = 0.0, score: float = 0.9) -> dict[str, Boxes2D]:
    """What a perfect witness sees of some boxes."""
    corners = projected(of, CAMERA.camera_from_ego, CAMERA) + np.array([right_px, 0, right_px, 0])
    return {"front": Boxes2D(corners, np.array([COCO[name] for name in of.classes.tolist()]), np.full(len(of), score))}


def held(ours: Boxes3D, witness: dict[str, Boxes2D], frames: int = 1, range_m: float = 50.0) -> Agreement:
    each = ((frame(index), ours, witness) for index in range(frames))
    return agreement(list(compared(each, NUSCENES_CLASSES, range_m, has_poses=True)), worst=3)


CARS = boxes(("car", 10, -3), ("car", 12, 3), ("car", 20, 0), ("pedestrian", 8, 0.5), ("bicycle", 15, 8), score=1.0)


def test_a_box_is_projected_as_by_hand():
    near, far = 8.0, 12.0  # of the car's ends, at a height of 1.5 m as the camera
    expected = [500 - 500 * 0.9 / near, 300, 500 + 500 * 0.9 / near, 300 + 500 * 1.5 / near]
    corners = projected(boxes(("car", (near + far) / 2, 0)), CAMERA.camera_from_ego, CAMERA)
    assert corners[0] == pytest.approx(expected)
    assert np.isnan(projected(boxes(("car", 1, 0)), CAMERA.camera_from_ego, CAMERA)).all()  # partly behind the camera


def test_what_a_perfect_witness_sees_is_found_and_confirmed():
    found = held(CARS, seen(CARS), frames=8)
    assert found.score == found.low == found.high == pytest.approx(1)
    assert (found.kept, found.frames) == (pytest.approx(1), (8, 8))
    assert {(part.found, part.confirmed) for part in found.groups.values()} == {(1, 1)}
    assert found.groups["vehicles"].objects == found.groups["vehicles"].boxes == 3 * 8
    assert found.worst == ()


def test_half_of_the_boxes_find_half_of_the_objects():
    found = held(CARS[[0, 2]], seen(CARS))
    assert found.groups["vehicles"].found == pytest.approx(2 / 3)
    assert found.groups["vehicles"].confirmed == 1
    assert (found.groups["people"].found, found.groups["people"].boxes) == (0, 0)
    assert found.worst == ((FrameStamp(0, "", 0), 3),)
    # What the witness does not see is not confirmed, and groups do not explain each other.
    assert held(CARS, seen(CARS[[0]])).groups["vehicles"].confirmed == pytest.approx(1 / 3)
    people = {"front": replace(seen(CARS)["front"], classes=np.full(len(CARS), "person"))}
    assert held(CARS[CARS.classes == "car"], people).groups["vehicles"].confirmed == 0


def test_more_noise_is_less_agreement():
    random, many = np.random.default_rng(0), boxes(*[("car", 8 + 3 * k, 2.5 * (k % 5 - 2)) for k in range(10)])
    scores = []
    for sigma in (0.0, 0.35, 0.7, 1.5, 3.0):
        noise = [np.c_[random.normal(0, sigma, (len(many), 2)), np.zeros(len(many))] for _ in range(12)]
        each = ((frame(i), replace(many, centers=many.centers + off), seen(many)) for i, off in enumerate(noise))
        scores.append(agreement(list(compared(each, NUSCENES_CLASSES, 50.0, has_poses=True))).score)
    assert scores == sorted(scores, reverse=True)


@pytest.mark.parametrize(
    ("ours", "counted"),
    [
        (boxes(("car", 20, 0), ("car", 10, 0)), 1),  # one hides the other
        (boxes(("car", 10, 9.5)), 0),  # most of it is outside of the image
        (boxes(("pedestrian", 58, 0)), 0),  # 15.5 pixels high
        (boxes(("car", 48, 0), ("car", 30, 5)), 1),  # one beyond 40 m
        (boxes(("car", 10, 0), score=0.2), 0),  # not shown
    ],
)
def test_boxes_that_tell_nothing_are_not_counted(ours: Boxes3D, counted: int):
    range_m = 60.0 if ours.centers[0, 0] > 50 else 40.0
    assert sum(part.boxes for part in held(ours, seen(ours[:0]), range_m=range_m).groups.values()) == counted


def of_image(name: str, *corners: float, score: float = 0.9) -> Boxes2D:
    return Boxes2D(np.array([corners]), np.array([name]), np.array([score]))


def joined(*parts: Boxes2D) -> dict[str, Boxes2D]:
    columns = ([getattr(part, name) for part in parts] for name in ("corners", "classes", "scores"))
    return {"front": Boxes2D(*map(np.concatenate, columns))}


BICYCLE = of_image("bicycle", 300, 330, 360, 380)


@pytest.mark.parametrize(
    ("witness", "objects"),
    [
        (joined(of_image("car", 0, 320, 100, 420)), 0),  # goes on outside of the image
        (joined(of_image("car", 300, 320, 400, 335)), 0),  # 15 pixels high
        (joined(of_image("car", 300, 320, 400, 420, score=0.39)), 0),
        (joined(of_image("car", 300, 320, 400, 420), of_image("truck", 302, 320, 401, 420, score=0.5)), 1),
        (joined(BICYCLE, of_image("person", 310, 290, 350, 370)), 1),  # rides it
        (joined(of_image("traffic light", 300, 100, 320, 150)), 0),
    ],
)
def test_what_tells_nothing_is_no_object(witness: dict[str, Boxes2D], objects: int):
    assert sum(part.objects for part in held(boxes(), witness).groups.values()) == objects


def test_a_turned_camera_shows_as_a_shift():
    shift = held(CARS, seen(CARS, right_px=6.0)).shifts["front"]
    assert (shift.right_px, shift.down_px, shift.scale) == pytest.approx((6, 0, 1))


def test_what_no_box_explains_is_named():
    witness = joined(*seen(CARS).values(), of_image("traffic light", 300, 100, 320, 150))
    found = unexplained(frame(), CARS[1:4], witness, NUSCENES_CLASSES)["front"]
    assert found.tolist() == [True, *[False] * 3, True, False]


@pytest.mark.parametrize(
    ("off_m", "speed", "share"), [(0.0, 0.0, 1.0), (2.0, 4.0, 1.0), (1.0, 0.0, 0.75), (7.0, 4.0, 0.0)]
)
def test_a_box_is_kept_where_its_velocity_leads(off_m: float, speed: float, share: float):
    before, after = boxes(("car", 10, 0), speed=speed), boxes(("car", 10 + off_m, 0))
    assert kept(before, after, 0.5) == pytest.approx((0.8 * share, 0.8))
    if share == 1 and not off_m:  # one box keeps one
        assert kept(before[[0, 0]], after, 0.5) == pytest.approx((0.8, 1.6))


@pytest.mark.parametrize("step_s", [0.1, 0.5, 2.0])
def test_boxes_are_kept_if_they_are_there_half_a_second_later(step_s: float):
    frames = [frame(index, step_s) for index in range(6)]
    each = ((one, boxes(("car", 10 + one.stamp.timestamp_ns / 1e9, 0), speed=1.0), None) for one in frames)
    parts = list(compared(each, NUSCENES_CLASSES, 50.0, has_poses=True))
    assert [one.stamp for one in parts] == [one.stamp for one in frames]
    expected = {0.1: 2, 0.5: 5, 2.0: 0}[step_s]  # the last 0.4 s have no later frame
    assert sum(one.kept == pytest.approx((0.8, 0.8)) for one in parts) == expected


@pytest.mark.parametrize(("off_m", "within"), [(0.4, 4), (0.9, 3), (1.9, 2), (2.5, 1)])
def test_a_fit_is_half_overlap_and_half_the_place_of_the_feet(off_m: float, within: int):
    wide = replace(boxes(("car", 10, 0)), sizes_lwh=np.array([[2.0, 8.0, 1.5]]))
    ours = sightings(frame(), wide, seen(replace(wide, centers=wide.centers + [0, off_m, 0])), NUSCENES_CLASSES)
    assert ours["fit"][0] == pytest.approx((ours["overlap"][0] + within / 4) / 2)
    assert ours["overlap"][0] == pytest.approx((8 - off_m) / (8 + off_m))


def test_two_seconds_have_no_interval_and_an_empty_road_no_score():
    assert held(CARS, seen(CARS), frames=4).low is None
    empty = held(CARS, seen(CARS[:0]))
    assert empty.score is None
    assert "tell nothing" in empty.notes[0]
    assert empty.line == "agreement -"


def test_the_numbers_are_in_the_json():
    content = json.loads(json.dumps(held(CARS, seen(CARS[:3])).to_dict()))
    assert content["groups"]["vehicles"] == {"found": 1.0, "confirmed": 1.0, "objects": 3, "boxes": 3}
    assert content["groups"]["people"]["found"] is None
    assert {"score", "low", "high", "kept", "cameras", "distances", "shifts", "worst_frames", "notes"} <= set(content)


def test_the_numbers_of_a_reference_stand_beside():
    lines = held(CARS, seen(CARS[:3]), frames=8).table(held(CARS, seen(CARS), frames=2)).splitlines()
    rows = {cells[0]: cells[1:] for line in lines if (cells := line.split())}
    assert (rows["agreement"][-2:], rows["reference"][-2:]) == (["8", "8"], ["2", "2"])
    assert rows["people"] == ["-", "0", "0.00", "8", "1.00", "2", "1.00", "2"]


def test_what_a_run_saw_is_read_back(tmp_path: Path):
    with ImageBoxesWriter(tmp_path / "image_boxes.csv") as file:
        file.write(FrameStamp(3, "a", 7), {"front": BICYCLE})
    (stamp,), (cameras,) = zip(*seen_in_run(tmp_path / "image_boxes.csv").items(), strict=True)
    assert stamp == (3, 7)
    assert cameras["front"].corners.tolist() == BICYCLE.corners.tolist()


@pytest.mark.parametrize("row", ["1,2", "3,a,7,front,car,0.5,1,2,3,nan", f"3,a,7,{'x' * 200_000},car,0.5,1,2,3,4", ""])
def test_what_no_run_saw_is_one_line(tmp_path: Path, row: str):
    path = tmp_path / "image_boxes.csv"
    path.write_text(f"{','.join(IMAGE_COLUMNS)}\n{row}\n" if row else row)
    with pytest.raises(InputError, match=r"image_boxes\.csv: "):
        seen_in_run(path)


@pytest.fixture
def unlabelled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The sample drive without its ground truth, with that as predictions beside it. The witness sees one car."""
    shutil.copytree(STREET, tmp_path / "drive", ignore=shutil.ignore_patterns("ground_truth*"))
    content = json.loads((STREET / "ground_truth.json").read_text())
    for each in content["frames"]:
        for box in each["boxes"]:
            box["score"] = 0.7
    (tmp_path / "boxes.json").write_text(json.dumps(content))
    witness = SimpleNamespace(seen=lambda frame: {name: of_image("car", 300, 220, 360, 280) for name in frame.images})
    monkeypatch.setattr(estimate, "load_witness", lambda: witness)
    return tmp_path


def test_eval_of_a_drive_without_labels_is_agreement(unlabelled: Path):
    command = ["eval", str(unlabelled / "boxes.json"), str(unlabelled / "drive")]
    printed = CliRunner().invoke(app, [*command, "--worst", "2", "--json"])
    found = json.loads(printed.stdout)["agreement"]
    assert 0 <= found["low"] <= found["score"] <= found["high"] <= 1
    assert found["groups"]["vehicles"]["objects"] == 6 * found["looked_at"]
    assert (len(found["worst_frames"]), found["looked_at"]) == (2, 7)
    files = ("--csv", str(unlabelled / "a.csv"), "--latex", str(unlabelled / "a.tex"))
    assert "agreement 0." in CliRunner().invoke(app, [*command, *files]).stdout
    rows = [line.split(",") for line in (unlabelled / "a.csv").read_text().splitlines()]
    assert ["agreement", "agreement", "score", str(found["score"])] in rows
    assert ["groups", "vehicles", "of objects", str(found["groups"]["vehicles"]["objects"])] in rows
    assert "% distances" in (unlabelled / "a.tex").read_text()


def test_a_run_without_a_detector_has_the_boxes_of_the_witness(unlabelled: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(estimate, "SHORT", 0)
    (unlabelled / "mini.toml").write_text(MINI_TOML)
    model = bevcli.load_model(unlabelled / "mini.toml", untrained=True)
    drive = bevcli.open_sequence(unlabelled / "drive", frames=slice(0, 4))
    options = bevcli.RunOptions(score_without_labels=True, recording=bevcli.RecordingOptions("minimal"))
    bevcli.run_into_folder(model, drive, unlabelled / "out", options)
    assert [index for index, _ in seen_in_run(unlabelled / "out" / "image_boxes.csv")] == [0, 3]
    found = estimate.agreement_of_boxes(unlabelled / "out", drive)
    assert (found.frames, found.groups["vehicles"].objects) == ((4, 2), 6 * 2)


def test_eval_of_a_drive_without_labels_refuses_options_of_labels(unlabelled: Path):
    command = ["eval", str(unlabelled / "boxes.json"), str(unlabelled / "drive"), "--tracking"]
    with pytest.raises(InputError, match=r"--tracking: .* has no ground truth"):
        CliRunner().invoke(app, command, catch_exceptions=False)


@pytest.mark.slow
def test_a_run_validate_and_the_library_agree(tmp_path: Path):
    shutil.copytree(STREET, tmp_path / "drive", ignore=shutil.ignore_patterns("ground_truth*"))
    drive = str(tmp_path / "drive")
    ran = CliRunner().invoke(app, ["run", drive, "--score-without-labels", "--out", str(tmp_path / "out")])
    assert ran.exit_code == 0, ran.output
    validated = CliRunner().invoke(app, ["validate", "--model", "demo", "--data", drive, "--json"])
    score = json.loads(validated.stdout)["agreement"]["score"]
    assert f"agreement {score:.2f}" in ran.stdout


@pytest.mark.slow
def test_the_witness_is_the_eye_of_photographs():
    model, drive = bevcli.load_model("photographs", device="cpu"), bevcli.open_sequence(STREET)
    first, prediction = next(iter(bevcli.run(model, drive)))
    for name, own in load_witness().seen(first).items():
        sure = prediction.image_boxes[name].scored(0.3)
        assert np.allclose(own.scored(0.3).corners, sure.corners, atol=0.5)
