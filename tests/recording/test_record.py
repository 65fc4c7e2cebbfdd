"""A drive is recorded without a model: its labels alone, and boxes of one or two files against them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from memory_drive import MemoryDrive
from recorded_drive import boxes_ahead, predict, recorded, with_truth

from bevcli.errors import InputError
from bevcli.frame import BevMap, Drive, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import rigid
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.log_static import Recorded, RecordedBoxes, legend_entries
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader, summarise
from bevcli.workshop.formats.convert import read_recording, write_boxes
from bevcli.workshop.formats.nuscenes_output import write_submission
from bevcli.workshop.scores.record import names_of, record, record_steps
from bevcli.workshop.video import RecordedImages, draw_frame, tiles

CAR = (255, 158, 44)
ORANGE, VIOLET = entities.LAYER_COLORS
NAMES = ("a",), ("a", "b")


class Labelled(MemoryDrive):
    """A drive with a car, and with a bicycle that `boxes_of` does not have."""

    def load(self, index: int) -> Frame:
        return replace(with_truth(super().load(index)), sample_token=f"token-{index}")


def boxes_of(drive: MemoryDrive, index: int) -> Boxes3D:
    """The boxes of `recorded_drive` in the world frame."""
    frame = drive.load(index)
    return boxes_ahead().transformed(frame.world_from_ego.matrix @ frame.rig.ego_from_bev)


def boxes_file(drive: MemoryDrive, places: range) -> BoxesFile:
    stamped = [(drive.load(place), boxes_of(drive, place)) for place in places]
    frames = [FrameBoxes(f.stamp, f.world_from_ego, b, {"sample_token": f.sample_token}) for f, b in stamped]
    return BoxesFile("world", tuple(frames))


def frames_of(path: Path) -> list[RecordedFrame]:
    return list(RecordingReader(path).frames())


def color(frame: RecordedFrame, entity: str, component: str = "Boxes3D:colors") -> set[tuple[int, ...]]:
    """Without opacity."""
    return {tuple(packed.to_bytes(4, "big")[:3]) for packed in frame.integers(entity, component)}


def lines_of(drive: Drive, boxes: Path | None, path: Path) -> list[str]:
    """The lines for the user of a recording that is written."""
    return [step for step in record_steps(drive, boxes, path) if isinstance(step, str)]


def numbers_of(value) -> list:
    """The numbers and texts in lists of lists."""
    return [number for each in value for number in numbers_of(each)] if isinstance(value, list) else [value]


def test_labels_alone_are_boxes_in_their_colours(tmp_path):
    lines = lines_of(Labelled(2), None, tmp_path / "r.rrd")
    first, _ = frames_of(tmp_path / "r.rrd")
    assert first.texts(entities.BOXES, "name") == ["car", "bicycle"]
    in_image = color(first, entities.overlay("CAM_FRONT", "boxes"), "LineStrips2D:colors")
    assert CAR in in_image
    assert len(in_image) == 2
    assert not first.has(entities.GROUND_TRUTH, "name")
    assert first.texts(entities.overlay("CAM_FRONT", "boxes/labels"), "Points2D:labels") == ["car", "bicycle"]
    assert first.texts(entities.RUN, "title") == ["memory · labels"]
    assert not lines


def test_boxes_of_one_file_are_drawn_as_those_of_a_model(tmp_path):
    drive = Labelled(2)
    steps = ((frame, predict(frame)) for frame in map(drive.load, range(2)))
    of_model = recorded(tmp_path / "model.rrd", drive, steps, options=RecordingOptions("minimal"))
    write_boxes(boxes_file(drive, range(2)), tmp_path / "mine.json")
    record(drive, tmp_path / "mine.json", tmp_path / "file.rrd")
    pairs = list(zip(of_model, frames_of(tmp_path / "file.rrd"), strict=True))
    drawn = [entity for entity in pairs[0][0].rows if entity.endswith(("boxes", "labels", "truth", "missed", "false"))]
    assert len(drawn) > 20
    for of_model, of_file in pairs:
        for entity in drawn:
            for component, value in of_model.rows[entity].items():
                both = [numbers_of(each.as_py()) for each in (value, of_file.rows[entity][component])]
                assert both[0] == pytest.approx(both[1], abs=1e-4), f"{entity} {component}"


def test_beyond_the_range_of_its_class_nothing_is_missed(tmp_path):
    """nuScenes scores barriers up to 30 m, cars up to 50 m."""
    drive = Labelled(1)
    far = replace(boxes_ahead()[[0, 0]], classes=np.array(["barrier", "car"]), centers=np.array([[0, 35, 0.0]] * 2))
    frame = drive.load(0)
    truth = far.transformed(frame.world_from_ego.matrix @ frame.rig.ego_from_bev)
    drive.load = lambda place: replace(frame, ground_truth=truth)  # type: ignore[method-assign]
    [missed] = frames_of(record(drive, [Boxes3D.empty()], tmp_path / "missed.rrd"))
    assert missed.texts(entities.MISSED, "name") == ["car"]
    assert missed.texts(entities.GROUND_TRUTH, "name") == ["barrier"]
    drive.load = lambda place: replace(frame, ground_truth=Boxes3D.empty())  # type: ignore[method-assign]
    [false] = frames_of(record(drive, [truth], tmp_path / "false.rrd"))
    assert len(false.strips(entities.BEV_FALSE, "LineStrips2D:strips")) == 2  # the two diagonals of one box


def test_frames_of_a_submission_are_matched_by_token(tmp_path):
    """Of a frame that the file lacks, no label is missed, and no trail of the frame before stays."""
    drive = Labelled(2)
    tracked = replace(boxes_of(drive, 0), instances=np.array(["1", "2", "3"]))
    write_boxes(BoxesFile("world", (FrameBoxes(drive.stamps[0], drive.pose(0), tracked),)), tmp_path / "a.json")
    first, last = frames_of(record(drive, tmp_path / "a.json", tmp_path / "a.rrd"))
    assert entities.track("car", "1") in first.rows
    assert entities.track("car", "1") not in last.rows
    drive = Labelled(3)
    write_submission(boxes_file(drive, range(2)), tmp_path / "results_nusc.json")
    lines = lines_of(drive, tmp_path / "results_nusc.json", tmp_path / "r.rrd")
    first, _, last = frames_of(tmp_path / "r.rrd")
    assert lines == ["results_nusc: has boxes of 2 of 3 frames, matched by sample_token"]
    assert first.texts(entities.MISSED, "name") == ["bicycle"]
    assert first.texts(entities.BOXES, "name") == ["car", "pedestrian"]  # the bus is below the score
    assert last.texts(entities.MISSED, "name") == last.texts(entities.BOXES, "name") == []
    assert last.texts(entities.GROUND_TRUTH, "name") == ["car", "bicycle"]
    assert last.texts(entities.EVENTS, "TextLog:text") == ["frame 2: results_nusc does not have this frame"]


def test_boxes_of_another_drive_are_told(tmp_path):
    drive = Labelled(1)
    file = boxes_file(drive, range(1))
    stamp = replace(drive.stamps[0], scene="b", timestamp_ns=7)
    far = file.frames[0].boxes.transformed(rigid((0, -2000, 0)))
    write_boxes(BoxesFile("world", (FrameBoxes(stamp, drive.pose(0), far),)), tmp_path / "a.json")
    lines = lines_of(drive, tmp_path / "a.json", tmp_path / "r.rrd")
    assert lines[0] == "a: has boxes of 1 of 1 frame, matched by frame index, as scenes or times differ"
    assert re.fullmatch(r"warning: a: the nearest box is 19\d\d m from the vehicle: is it of this drive\?", lines[1])


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two models: the second one has one box, 1 m beside that of the first one."""
    drive, folder = Labelled(1), tmp_path_factory.mktemp("two")
    moved = boxes_of(drive, 0)[[0]]
    boxes = {"a/b c": [boxes_of(drive, 0)], "new": [replace(moved, centers=moved.centers + (1, 0, 0))]}
    return record(drive, boxes, folder / "two.rrd", score=0.0)


def test_two_models_are_layers_in_two_colours(two):
    [frame] = frames_of(two)
    for name, own, count in (("a/b c", ORANGE, 3), ("new", VIOLET, 1)):
        assert len(frame.texts(entities.layer(entities.WORLD, name), "name")) == count
        assert color(frame, entities.layer(entities.WORLD, name)) == {own}
        assert color(frame, entities.layer(entities.BEV, name), "LineStrips2D:colors") == {own}
        in_image = entities.layer(entities.camera("CAM_FRONT"), name)
        assert color(frame, in_image, "LineStrips2D:colors") == {own}
        assert color(frame, f"{in_image}/labels", "Points2D:colors") <= {own}
    assert frame.texts(entities.GROUND_TRUTH, "name") == ["car", "bicycle"]
    assert not frame.texts(entities.MISSED, "name")
    assert frame.values(entities.BOX_CURVES, "Scalars:scalars") == [3, 1]


def test_no_label_of_two_models_covers_another(two):
    [frame] = frames_of(two)
    parts = [f"{entities.layer(entities.camera('CAM_FRONT'), name)}/labels" for name in ("a/b c", "new")]
    heights = np.concatenate([frame.array(part, "Points2D:positions", 2) for part in parts])
    assert len(heights) > 1
    apart = np.abs(heights[:, None] - heights)[~np.eye(len(heights), dtype=bool)]
    assert ((apart[:, 0] > 30) | (apart[:, 1] > 14)).all()


def test_the_summary_and_the_video_name_both_models(two):
    [frame] = frames_of(two)
    assert "memory · a/b c · new" in summarise(two)
    assert "  boxes     4\n          3 a/b c\n          1 new\n" in summarise(two)
    canvas = draw_frame(frame, tiles(frame), RecordedImages()).astype(int)
    for own in (ORANGE, VIOLET):
        near = np.abs(canvas - own[::-1]).sum(-1) < 30
        assert near[:500, :1280].any()
        assert near[:, 1280:].any()
        assert near[500:, :1280].sum() > 150  # the legend
    with pytest.raises(InputError, match="compares a/b c and new"):
        read_recording(two)
    recorded = {names: Recorded(MemoryDrive(1), RecordedBoxes(names), RecordingOptions()) for names in ((), *NAMES)}
    texts = {names: [text for text, _ in legend_entries(made)] for names, made in recorded.items()}
    assert texts["a", "b"] == ["a", "b", "ground truth"]
    assert {"car", "ground truth", "missed, false"} <= set(texts["a",])
    assert "ground truth" not in texts[()]


def test_labelled_maps_and_classes_of_any_name_are_shown(tmp_path):
    drive = Labelled(2)
    frames = [drive.load(place) for place in range(2)]
    truth = replace(frames[0].ground_truth, classes=np.array(["Straßenbahn", "car"]))
    road = BevMap(np.ones((4, 4), np.uint8), (-8, 8), (-8, 8), {"road": 1})
    frames[0] = replace(frames[0], ground_truth=truth, ground_truth_map=road)
    drive.load = lambda place: frames[place]  # type: ignore[method-assign]
    first, last = frames_of(record(drive, path=tmp_path / "r.rrd"))
    assert first.texts(entities.RUN, "map_classes") == ["road"]
    assert first.texts(entities.RUN, "class_names")[-1] == "Straßenbahn"
    assert first.integers(entities.BOXES, "Boxes3D:class_ids") == [11, 1]
    assert first.has(entities.BEV_SEGMENTATION, "Image:buffer")
    assert not last.has(entities.BEV_SEGMENTATION, "Image:buffer")


def test_wrong_boxes_get_one_line(tmp_path):
    drive = Labelled(2)
    with pytest.raises(InputError, match=r"of 3 models \(expected at most 2\)"):
        record(drive, dict.fromkeys("abc", [Boxes3D.empty()] * 2))
    with pytest.raises(InputError, match=r"found 1 \(expected 2, one for each frame\)"):
        record(drive, [Boxes3D.empty()])
    for boxes, found in ((boxes_of(drive, 0), "those of one frame"), ([predict(drive.load(0))] * 2, "a Prediction")):
        with pytest.raises(InputError, match=rf"found {found} \(expected a file, or a list with the Boxes3D of each"):
            record(drive, boxes)
    write_boxes(boxes_file(drive, range(2)), tmp_path / "a.json")
    other = json.loads((tmp_path / "a.json").read_text())
    for frame in other["frames"]:
        frame |= {"sample_token": "x" + frame["sample_token"], "frame": frame["frame"] + 90, "timestamp_ns": 1}
    other["frames"].pop()
    (tmp_path / "b.json").write_text(json.dumps(other))
    with pytest.raises(InputError, match=r"^b: predictions and ground truth have no frame in common"):
        record(drive, tmp_path / "b.json", tmp_path / "r.rrd")
    drive.has_ego_motion = False
    with pytest.raises(InputError, match="the boxes are in the world frame, and the drive has no ego-motion"):
        record(drive, tmp_path / "a.json", tmp_path / "r.rrd")


def test_files_have_short_names(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    runs = [tmp_path / "a" / "predictions.json", tmp_path / "b"]
    assert list(names_of(runs)) == ["a", "b"]
    assert list(names_of([tmp_path / "old.json", tmp_path / "new.json"])) == ["old", "new"]
    assert list(names_of([tmp_path / "a" / "x.json", tmp_path / "b" / "x.json"])) == ["a/x", "b/x"]
    with pytest.raises(InputError, match="have the same name"):
        names_of([tmp_path / "x.json", tmp_path / "x.json"])
