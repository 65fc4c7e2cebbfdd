"""What a recording holds, read back from the file; its rows equal those of rerun's archetypes."""

import gc
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun as rr
from memory_drive import MemoryDrive, WithoutImages, make_rig
from recorded_drive import NamedModel, bev_from_world, boxes_ahead, predict, record, recorded, with_truth

from bevcli.cli.run import _frame_warnings
from bevcli.errors import OutputError
from bevcli.frame import BevMap, CameraImage, NewStart, StartReason
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.entities import any_values, components, line_strips, packed, rgb_format, ui_points
from bevcli.recording.writer import Recording
from bevcli.viewer.recording_reader import RecordingReader, recorded_boxes

ONE = make_rig({"CAM_FRONT": 0.0})


@pytest.fixture(scope="module")
def standard(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    options = RecordingOptions(probes=((0.0, 10.0),))
    frames = record(path, MemoryDrive(3), options)
    return frames, list(RecordingReader(path).frames()), path


def entity_rows(path: Path, entity: str) -> list[tuple[bool, int]]:
    return [(c.is_static, c.num_rows) for c in RecordingReader(path).chunks() if c.entity_path == f"/{entity}"]


class UtmDrive(MemoryDrive):
    """Far from the origin of the world."""

    def pose(self, index: int) -> Pose:
        near = super().pose(index)
        return Pose(near.translation + [654321.0, 5345678.0, 512.0], near.quaternion)


def test_a_minimal_recording_has_boxes_anywhere_and_no_internals(tmp_path):
    frames = record(tmp_path / "utm.rrd", UtmDrive(2, ONE), RecordingOptions(level="minimal"))
    *_, last = RecordingReader(tmp_path / "utm.rrd").frames()
    back = recorded_boxes(last).boxes.transformed(bev_from_world(frames[-1]))
    np.testing.assert_allclose(back.centers, boxes_ahead()[:2].centers, atol=1e-3)
    assert not {entities.BEV_FEATURES, entities.BEV_ON_GROUND, entities.PILLARS, entities.BEV_HISTORY} & set(last.rows)
    with pytest.raises(OutputError, match=r"r\.rrd"), Recording(tmp_path / "no/r.rrd", UtmDrive(1), NamedModel()):
        pass


def test_boxes_come_back_in_the_world(standard):
    frames, recorded, _ = standard
    assert [frame.index for frame in recorded] == [0, 1, 2]
    for frame, read in zip(frames, recorded, strict=True):
        boxes = recorded_boxes(read)
        assert boxes.stamp == frame.stamp
        np.testing.assert_allclose(boxes.world_from_ego.matrix, frame.world_from_ego.matrix, atol=1e-6)
        back = boxes.boxes.transformed(bev_from_world(frame))
        shown = boxes_ahead()[:2]  # the bus is below the score
        assert back.classes.tolist() == shown.classes.tolist()
        np.testing.assert_allclose(back.centers, shown.centers, atol=1e-3)
        np.testing.assert_allclose(back.sizes_lwh, shown.sizes_lwh, atol=1e-5)
        np.testing.assert_allclose(np.cos(back.yaws - shown.yaws), 1, atol=1e-6)
        np.testing.assert_allclose(back.velocities, shown.velocities, atol=1e-5)
        np.testing.assert_allclose(back.scores, shown.scores)


def test_ground_truth_is_divided_into_found_and_missed(standard):
    _, recorded, _ = standard
    for frame in recorded:
        assert frame.values(entities.GROUND_TRUTH, "name") == ["car"]
        assert frame.values(entities.MISSED, "name") == ["bicycle"]
        assert len(frame.values(entities.FALSE_BOXES, "LineStrips3D:strips")) == 2  # the pedestrian, crossed out


def test_every_view_has_its_entities(standard):
    _, recorded, _ = standard
    last = recorded[-1]
    for entity, component in {
        entities.EGO: "Transform3D:translation",
        entities.VEHICLE: "Mesh3D:vertex_positions",
        entities.RANGE_RINGS: "LineStrips3D:strips",
        entities.BEV_ON_GROUND: "Mesh3D:albedo_texture_buffer",
        entities.PILLARS: "Points3D:positions",
        entities.TRAJECTORY: "LineStrips3D:strips",
        entities.VELOCITY: "Arrows3D:vectors",
        entities.BEV_FEATURES: "Image:buffer",
        entities.BEV_HISTORY: "Image:buffer",
        entities.BEV_BOXES: "LineStrips2D:strips",
        entities.BEV_PROBES: "Points2D:positions",
        entities.STAGE_CURVES: "Scalars:scalars",
        entities.BOX_CURVES: "Scalars:scalars",
        entities.image("CAM_BACK"): "EncodedImage:blob",
        entities.overlay("CAM_FRONT", "boxes"): "LineStrips2D:strips",
        entities.overlay("CAM_FRONT", "ground_truth"): "LineStrips2D:strips",
        entities.overlay("CAM_FRONT", "pillars"): "Points2D:positions",
        entities.overlay("CAM_FRONT", "probes"): "Points2D:positions",
    }.items():
        assert last.has(entity, component), f"{entity} {component}"


def test_static_entities_are_written_once(standard):
    *_, path = standard
    for entity in (entities.VEHICLE, entities.RANGE_RINGS, entities.PILLARS, entities.RUN, entities.BEV_VEHICLE):
        assert entity_rows(path, entity) == [(True, 1)]
    pinholes = [c for c in RecordingReader(path).chunks() if "Pinhole:resolution" in c.to_record_batch().schema.names]
    assert [c.is_static for c in pinholes] == [True] * 6


def test_boxes_are_projected_at_the_time_of_each_image(tmp_path):
    """Each camera has its own time: the vehicle stood 2 m farther back when CAM_FRONT took its image."""
    drive = MemoryDrive(1, ONE)
    frame = drive.load(0)
    image = frame.images["CAM_FRONT"]
    jpeg = cv2.imencode(".jpg", image.pixels_bgr)[1].tobytes()
    own = CameraImage(image.timestamp_ns, image.pixels_bgr, jpeg, "image/jpeg")
    earlier = Pose(frame.world_from_ego.translation - [2.0, 0, 0], frame.world_from_ego.quaternion)
    frame = replace(frame, images={"CAM_FRONT": own}, world_from_ego_at={"CAM_FRONT": earlier})
    (read,) = recorded(tmp_path / "r.rrd", drive, [(frame, predict(frame))])
    assert read.blob(entities.image("CAM_FRONT"), "EncodedImage:blob") == jpeg  # the bytes of a file are kept
    color = 0xFF9E2CFF  # the car's
    colors = np.array(read.values(entities.overlay("CAM_FRONT", "boxes"), "LineStrips2D:colors"))
    strips = np.array(read.values(entities.overlay("CAM_FRONT", "boxes"), "LineStrips2D:strips"))[colors == color]
    # bev stands at x 0.94 in ego, the camera at 0.9: the car's rear is 12 - 2.25 + 0.04 + 2 m away, 1.9 m wide.
    focal, middle = 0.8 * 320, 160
    half = focal * 0.95 / (12 - 2.25 + 0.94 - 0.9 + 2)
    np.testing.assert_allclose(strips[..., 0].max(), middle + half, atol=0.1)
    np.testing.assert_allclose(strips[..., 0].min(), middle - half, atol=0.1)


def test_a_dropped_image_clears_the_view_and_logs_an_event(tmp_path):
    record(tmp_path / "r.rrd", WithoutImages({1: ("CAM_BACK", "CAM_FRONT")}, count=3))
    recorded = list(RecordingReader(tmp_path / "r.rrd").frames())
    shown = [bool(frame.blob(entities.image("CAM_BACK"), "EncodedImage:blob")) for frame in recorded]
    assert shown == [True, False, True]
    texts = [frame.texts(entities.overlay("CAM_BACK", entities.NO_IMAGE), "Points2D:labels") for frame in recorded]
    assert texts == [[], ["CAM_BACK: no image"], []]
    said = [f"frame 1: camera {name} has no image: missing" for name in ("CAM_BACK", "CAM_FRONT")]
    assert [text for text in events(tmp_path / "r.rrd") if "has no image" in text] == said
    for kind in ("boxes", "ground_truth"):
        drawn = [len(frame.strips(entities.overlay("CAM_FRONT", kind), "LineStrips2D:strips")) for frame in recorded]
        assert drawn[0] == drawn[2] > drawn[1] == 0
    assert recorded[1].texts(entities.BOXES, "name") == ["car", "pedestrian"]


def test_a_frame_without_results_shows_none_of_the_one_before(tmp_path):
    drive = MemoryDrive(4, ONE)
    ground_map = BevMap(np.ones((4, 4), np.uint8), (-10, 10), (-10, 10))
    with Recording(tmp_path / "r.rrd", drive, NamedModel(), RecordingOptions(probes=((0, 10),))) as recording:
        for frame in map(drive.load, range(4)):
            found = replace(predict(frame), segmentation=ground_map)
            if frame.stamp.index == 2:
                recording.log(frame, replace(found, bev=None, attention=None, segmentation=None, skipped=True))
            else:
                recording.log(with_truth(frame), found)
    recorded = list(RecordingReader(tmp_path / "r.rrd").frames())
    flat = (entities.BEV_FEATURES, entities.BEV_SEGMENTATION, entities.BEV_HISTORY)
    of_frames = [{entity: frame.has(entity, "Image:buffer") for entity in flat} for frame in recorded]
    assert of_frames == [dict.fromkeys(flat, index != 2) for index in range(4)]
    for entity in (entities.BEV_ON_GROUND, entities.SEGMENTATION_ON_GROUND):
        assert [frame.has(entity, "Mesh3D:vertex_positions") for frame in recorded] == [True, True, False, True]
    for entity in (entities.BEV_PROBES, entities.overlay("CAM_FRONT", "probes")):
        assert [len(frame.array(entity, "Points2D:positions", 2)) for frame in recorded] == [1, 1, 0, 1]
    assert [len(frame.texts(entities.MISSED, "name")) for frame in recorded] == [1, 1, 0, 1]


def test_a_recording_of_an_untrained_model_is_labelled(tmp_path):
    record(tmp_path / "r.rrd", MemoryDrive(1, ONE), untrained=True)
    (frame,) = RecordingReader(tmp_path / "r.rrd").frames()
    assert frame.values(entities.RUN, "untrained") == [True]
    assert "untrained" in frame.values(entities.RUN, "TextDocument:text")[0]
    assert frame.values(entities.MISSED, "name") == []  # random boxes match nothing: misses are not shown
    assert any("UNTRAINED" in text for text in events(tmp_path / "r.rrd"))


def events(path: Path) -> list[str]:
    batches = [c.to_record_batch() for c in RecordingReader(path).chunks() if c.entity_path == "/events"]
    return [text for batch in batches for (text,) in batch.column("TextLog:text").to_pylist()]


def test_the_reason_of_a_restart_without_history_is_an_event(tmp_path):
    drive = MemoryDrive(4, ONE, scenes="aabb")
    first, new = NewStart(StartReason.FIRST_FRAME), NewStart(StartReason.NEW_SCENE)
    reasons = (first, None, new, NewStart(StartReason.GAP, 9.0))
    with Recording(tmp_path / "r.rrd", drive, NamedModel()) as recording:
        recording.event("a note", "WARN")
        for place in range(4):
            frame = drive.load(place)
            recording.log(frame, replace(predict(frame), started_anew=reasons[place]))
    read = next(RecordingReader(tmp_path / "r.rrd").frames())
    assert read.has(entities.EVENTS, "TextLog:text")  # also those before the first frame have a timestamp
    assert events(tmp_path / "r.rrd") == [
        "a note",
        'frame 0: no history: first frame, scene "a"',
        'frame 2: no history: new scene, scene "b"',
        'frame 3: no history: gap of 9.0 s, scene "b"',
    ]


@pytest.mark.parametrize("changes", [{"skipped": True}, {"not_finite": "neck"}], ids=["skipped", "not finite"])
def test_recording_and_command_line_tell_a_failed_frame_alike(tmp_path, changes):
    drive = MemoryDrive(1, ONE, scenes=[""])
    frame = drive.load(0)
    gap = NewStart(StartReason.GAP, 2.5)
    failed = replace(predict(frame), boxes=Boxes3D.empty(), bev=None, started_anew=gap, **changes)
    recorded(tmp_path / "r.rrd", drive, [(frame, failed)])
    assert sorted(events(tmp_path / "r.rrd")) == sorted(_frame_warnings(frame, failed, standing=None))


def test_a_frame_adds_at_most_400_kb(standard):
    """At most 400 kB and 5 % of the images' bytes are added to the encoded images."""
    *_, path = standard
    images = sum(
        len(frame.blob(entities.image(name), "EncodedImage:blob"))
        for frame in RecordingReader(path).frames()
        for name in MemoryDrive(1).rig.names
    )
    assert path.stat().st_size < 1.05 * images + 3 * 400_000


@pytest.mark.filterwarnings("error")
def test_a_frame_without_boxes_shows_none(tmp_path, monkeypatch):
    monkeypatch.setenv("RERUN_STRICT", "1")
    drive = MemoryDrive(2, ONE)
    first, second = (with_truth(drive.load(place)) for place in range(2))
    nothing = replace(second, ground_truth=Boxes3D.empty()), replace(predict(second), boxes=Boxes3D.empty())
    *_, last = recorded(tmp_path / "r.rrd", drive, [(first, predict(first)), nothing])
    assert len(recorded_boxes(last).boxes) == 0
    assert last.values(entities.GROUND_TRUTH, "name") == []
    for entity in (entities.BEV_BOXES, entities.overlay("CAM_FRONT", "boxes")):
        assert last.values(entity, "LineStrips2D:strips") == []


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted on Linux")
def test_the_threads_of_earlier_recordings_end(tmp_path):
    def streams() -> int:
        names = [task / "comm" for task in Path("/proc/self/task").iterdir()]
        return sum("RecordingStream" in name.read_text() for name in names if name.exists())

    counts = []
    for number in range(5):
        record(tmp_path / f"{number}.rrd", MemoryDrive(1))
        gc.collect()
        counts.append(streams())
    # Those of the last recording and of its blueprint end when the next one begins, in a thread.
    assert counts[-1] - counts[0] <= 2


RANDOM = np.random.default_rng(0)
POINTS_2D, POINTS_3D = RANDOM.normal(size=(5, 2)), RANDOM.normal(size=(5, 3))
STRIPS_2D, STRIPS_3D = RANDOM.normal(size=(5, 4, 2)), RANDOM.normal(size=(5, 4, 3))
COLORS = RANDOM.integers(0, 256, (5, 3)).astype(np.uint8)
WITH_OPACITY = RANDOM.integers(0, 256, (5, 4)).astype(np.uint8)
IMAGE = RANDOM.integers(0, 256, (6, 4, 3)).astype(np.uint8)
POSE = RANDOM.normal(size=(3, 3))
BOXES = {"centers": POINTS_3D, "half_sizes": POINTS_3D, "quaternions": WITH_OPACITY / 255}
BOXES |= {"fill_mode": "majorwireframe"}
RADIUS = rr.Radius.ui_points(1.5)


def rows(made):
    return [(part.component_descriptor(), part.as_arrow_array()) for part in made]


@pytest.mark.parametrize(
    ("archetype", "fields", "expected"),
    [
        (
            rr.LineStrips2D,
            {"strips": STRIPS_2D, "colors": COLORS, "radii": ui_points(1.5), "draw_order": 30},
            rr.LineStrips2D(STRIPS_2D, colors=COLORS, radii=RADIUS, draw_order=30),
        ),
        (
            rr.LineStrips3D,
            {"strips": STRIPS_3D, "colors": WITH_OPACITY, "radii": 0.06},
            rr.LineStrips3D(STRIPS_3D, colors=WITH_OPACITY, radii=0.06),
        ),
        (rr.LineStrips2D, {"strips": STRIPS_2D[:0]}, rr.LineStrips2D([])),
        (
            rr.Points2D,
            {"positions": POINTS_2D, "labels": ["ä", "", "car", "a", "b"], "colors": (1, 2, 3), "show_labels": True},
            rr.Points2D(POINTS_2D, labels=["ä", "", "car", "a", "b"], colors=(1, 2, 3), show_labels=True),
        ),
        (rr.Points2D, {"positions": POINTS_2D, "colors": packed(COLORS)}, rr.Points2D(POINTS_2D, colors=COLORS)),
        (rr.Boxes3D, BOXES | {"class_ids": np.arange(5)}, rr.Boxes3D(**BOXES, class_ids=range(5))),
        (
            rr.Arrows3D,
            {"vectors": POINTS_3D, "origins": POINTS_3D, "colors": None},
            rr.Arrows3D(vectors=POINTS_3D, origins=POINTS_3D),
        ),
        (rr.Transform3D, {"translation": POSE[0], "mat3x3": POSE.T}, rr.Transform3D(translation=POSE[0], mat3x3=POSE)),
        (rr.Scalars, {"scalars": np.array([1, 2])}, rr.Scalars([1, 2])),
        (
            rr.Image,
            {"buffer": IMAGE.reshape(-1), "format": rgb_format(4, 6), "draw_order": -5},
            rr.Image(IMAGE, draw_order=-5),
        ),
        (
            rr.EncodedImage,
            {"blob": np.frombuffer(b"JPEG", np.uint8), "media_type": "image/jpeg"},
            rr.EncodedImage(contents=b"JPEG", media_type="image/jpeg"),
        ),
    ],
)
def test_components_equal_those_of_the_archetype(archetype, fields, expected):
    made = components(archetype, **fields)
    of_rerun = dict(rows(expected.as_component_batches()))
    assert made.keys() == of_rerun.keys()
    for descriptor, array in of_rerun.items():
        assert made[descriptor].type == array.type
        assert made[descriptor].equals(array)


def test_any_values_equal_those_of_rerun():
    values = {"score": RANDOM.normal(size=3), "scene": "a", "timestamp_ns": 10**18}
    expected = dict(rows(rr.AnyValues(**values).as_component_batches()))
    for descriptor, array in any_values(**values).items():
        assert array.type == expected[descriptor].type
        assert array.equals(expected[descriptor])


@pytest.mark.parametrize("lengths", [[], [2], [5, 2, 3, 1], [2, 2]])
def test_strips_equal_those_of_rerun(lengths):
    random = np.random.default_rng(0)
    flat, solid = ([random.normal(size=(length, size)) for length in lengths] for size in (2, 3))
    of_flat = line_strips(np.concatenate([np.zeros((0, 2)), *flat]), lengths)
    of_solid = line_strips(np.concatenate([np.zeros((0, 3)), *solid]), lengths)
    assert of_flat.equals(rr.components.LineStrip2DBatch(flat).as_arrow_array())
    assert of_solid.equals(rr.components.LineStrip3DBatch(solid).as_arrow_array())
    assert rr.LineStrips2D(of_flat).strips.as_arrow_array().equals(of_flat)
