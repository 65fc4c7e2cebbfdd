"""The views: legend, colours of maps, range rings, size of the camera views, titles, speed, street map."""

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import pytest
from memory_drive import MemoryDrive, make_rig
from recorded_drive import GRID, TINY, NamedModel, predict, record

from bevcli.frame import MAP_CLASSES, MOST_MAP_CLASSES, BevMap, DriveFacts, class_bits
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import GeoOrigin
from bevcli.model.config import ModelConfig
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.blueprint import frame_rate_hz
from bevcli.recording.entities import (
    BACKGROUND,
    GROUND_TRUTH_COLOR,
    MAP_COLORS,
    MISSED_COLOR,
    OTHER_MAP_COLORS,
    class_colors,
    map_colors,
)
from bevcli.recording.log_static import FROM_RENDERED, UNTRAINED, Recorded, legend_entries, ring_distances_m
from bevcli.recording.writer import Recording
from bevcli.viewer.recording_reader import RecordingReader


class MadeDrive(MemoryDrive):
    """A drive that states facts."""

    def __init__(self, count: int = 2, rendered: bool = False, geo_origin: GeoOrigin | None = None):
        super().__init__(count)
        self.facts = DriveFacts(rendered, geo_origin)


def lab(color) -> np.ndarray:
    return cv2.cvtColor(np.float32([[color]]) / 255, cv2.COLOR_RGB2LAB)[0, 0]


COLORS_OF_MAPS = (*MAP_COLORS.values(), *OTHER_MAP_COLORS)


@pytest.mark.parametrize("index", range(len(COLORS_OF_MAPS)))
def test_a_map_colour_cannot_be_taken_for_a_box_or_another_class(index):
    color, others = COLORS_OF_MAPS[index], [*COLORS_OF_MAPS[:index], *COLORS_OF_MAPS[index + 1 :]]
    of_boxes = [*class_colors(NUSCENES_CLASSES.values()).values(), GROUND_TRUTH_COLOR, MISSED_COLOR]
    nearest = min(np.linalg.norm(lab(color) - lab(other)) for other in of_boxes)
    assert nearest > 22  # 2 is the smallest difference that people see side by side
    assert min(np.linalg.norm(lab(color) - lab(other)) for other in others) > 12
    assert np.linalg.norm(lab(color) - lab(BACKGROUND)) > 12


def test_map_classes_of_any_name_have_different_colours():
    names = ["vehicle", *"abcdefg"]
    colors = map_colors(names)
    assert list(colors) == names
    assert len(set(colors.values())) == MOST_MAP_CLASSES == len(names)
    assert colors["vehicle"] == MAP_COLORS["vehicle"]
    assert map_colors(names) == colors
    assert map_colors(["b", "a"])["b"] == map_colors(["a", "b"])["a"]  # by their order


def test_the_legend_names_every_class_and_map_class():
    def legend(config):
        recorded = Recorded(MadeDrive(), NamedModel(config=config), RecordingOptions())
        return [text for text, _ in legend_entries(recorded)]

    names = legend(replace(TINY, heads=("detection", "segmentation")))
    assert set(TINY.classes) <= {name.replace(" ", "_") for name in names}
    assert {f"map: {name.replace('_', ' ')}" for name in MAP_CLASSES} <= set(names)
    assert not any(text.startswith("map") for text in legend(TINY))


def test_range_rings_end_with_the_grid():
    assert ring_distances_m(BevGrid(64, 64, (-32.0, 32.0), (-32.0, 32.0))) == [10, 20, 30]
    assert ring_distances_m(BevGrid(64, 64, (-51.2, 51.2), (-51.2, 51.2))) == [10, 20, 30, 40, 50]
    assert ring_distances_m(BevGrid(64, 64, (-30.0, 30.0), (-15.0, 45.0))) == [10]


@dataclass(frozen=True)
class Weights(NamedModel):
    """A model with the weights of the package."""

    bundled: bool = True


def test_titles_say_when_the_weights_do_not_know_such_images():
    def note(model, rendered):
        return Recorded(MadeDrive(rendered=rendered), model, RecordingOptions()).note

    assert note(Weights(), rendered=False) == FROM_RENDERED
    assert note(Weights(), rendered=True) == ""
    assert note(NamedModel(), rendered=False) == ""
    assert note(NamedModel(untrained=True), rendered=True) == UNTRAINED


def test_note_legend_and_speed_are_in_the_recording(tmp_path):
    drive = MadeDrive()
    with Recording(tmp_path / "r.rrd", drive, Weights()) as recording:
        recording.log(drive.load(0), predict(drive.load(0)))
    (frame,) = RecordingReader(tmp_path / "r.rrd").frames()
    assert frame.values(entities.RUN, "note") == [FROM_RENDERED]
    chunks = [c.to_record_batch() for c in RecordingReader(tmp_path / "r.rrd").chunks() if c.entity_path == "/events"]
    texts = [text for batch in chunks for (text,) in batch.column("TextLog:text").to_pylist()]
    assert "The weights were trained on rendered streets; these images are not rendered." in texts
    assert "traffic cone" in frame.values(f"{entities.LEGEND}/texts", "Points2D:labels")
    assert frame.array(entities.SPEED_CURVE, "Scalars:scalars", 1)[0, 0] == pytest.approx(6.0 * 3.6)
    assert frame.values(entities.SPEED, "Points3D:labels") == ["22 km/h"]


def test_the_segmentation_lies_on_the_ground(tmp_path):
    drive = MemoryDrive(1)
    drive.has_ego_motion = False
    cells = np.zeros((20, 20), dtype=np.uint8)
    cells[0, 0] = MAP_CLASSES["vehicle"]  # the first row has the largest y
    maps = BevMap(cells, GRID.x_range_m, GRID.y_range_m)
    with Recording(tmp_path / "r.rrd", drive, NamedModel()) as recording:
        recording.log(drive.load(0), replace(predict(drive.load(0)), segmentation=maps))
    (frame,) = RecordingReader(tmp_path / "r.rrd").frames()
    assert entities.SPEED not in frame.rows  # without poses there is none
    texture = frame.blob(entities.SEGMENTATION_ON_GROUND, "Mesh3D:albedo_texture_buffer")
    assert tuple(texture[:3]) == MAP_COLORS["vehicle"]
    corners = frame.array(entities.SEGMENTATION_ON_GROUND, "Mesh3D:vertex_positions", 3)
    left_ahead = corners[3]  # bev x smallest, y largest
    assert left_ahead[0] == pytest.approx(51.2 + 0.94, abs=1e-3)  # in ego: forward
    assert left_ahead[1] == pytest.approx(51.2, abs=1e-3)


def test_a_map_is_painted_only_where_a_camera_looks(tmp_path):
    """With cameras to the front and the back, none to the sides; and in the second frame, to the front only."""
    drive = MemoryDrive(2, rig=make_rig({"CAM_FRONT": 0, "CAM_BACK": 180}))
    maps = BevMap(np.full((20, 20), MAP_CLASSES["vehicle"], np.uint8), GRID.x_range_m, GRID.y_range_m)
    with Recording(tmp_path / "r.rrd", drive, NamedModel()) as recording:
        for place in range(2):
            frame = drive.load(place)
            images = {name: image for name, image in frame.images.items() if place == 0 or name == "CAM_FRONT"}
            prediction = replace(predict(frame), segmentation=maps)
            recording.log(replace(frame, images=images), prediction)
    for frame, seen in zip(RecordingReader(tmp_path / "r.rrd").frames(), ("ahead behind", "ahead"), strict=True):
        painted = np.frombuffer(frame.blob(entities.BEV_SEGMENTATION, "Image:buffer"), np.uint8).reshape(20, 20, 3)
        places = {"ahead": painted[0, 9], "behind": painted[19, 9], "left": painted[9, 0], "right": painted[9, 19]}
        vehicle = {name for name, color in places.items() if tuple(color) == MAP_COLORS["vehicle"]}
        assert vehicle == set(seen.split())
        assert all(tuple(color) == BACKGROUND for name, color in places.items() if name not in vehicle)


class LaneConfig(ModelConfig):
    """The configuration of a model whose map has classes of its own; "kerb" has no colour of its own."""

    @property
    def map_classes(self):
        return ("drivable_area", "divider", "kerb")


def test_a_model_with_its_own_map_classes_is_drawn_with_a_legend(tmp_path):
    drive = MemoryDrive(1)
    cells = np.zeros((20, 20), dtype=np.uint8)
    cells[0, :3] = [1, 1 + 2, 4]
    config = LaneConfig(**{part.name: getattr(TINY, part.name) for part in fields(TINY)})
    maps = BevMap(cells, GRID.x_range_m, GRID.y_range_m, class_bits(config.map_classes))
    with Recording(tmp_path / "r.rrd", drive, NamedModel(config=config)) as recording:
        recording.log(drive.load(0), replace(predict(drive.load(0)), segmentation=maps))
    (frame,) = RecordingReader(tmp_path / "r.rrd").frames()
    texture = frame.blob(entities.SEGMENTATION_ON_GROUND, "Mesh3D:albedo_texture_buffer")
    drawn = [tuple(texture[3 * place : 3 * place + 3]) for place in range(4)]
    assert drawn == [MAP_COLORS["drivable_area"], MAP_COLORS["divider"], OTHER_MAP_COLORS[0], BACKGROUND]
    texts = frame.values(f"{entities.LEGEND}/texts", "Points2D:labels")
    assert {"map: drivable area", "map: divider", "map: kerb"} <= set(texts)
    assert not {"map: vehicle", "map: drivable road"} & set(texts)
    assert frame.values(entities.RUN, "map_classes") == ["drivable_area", "divider", "kerb"]


def test_a_drive_with_a_place_on_earth_has_a_street_map(tmp_path):
    drive = MadeDrive(3, geo_origin=GeoOrigin(48.1374, 11.5755, 90.0))
    record(tmp_path / "r.rrd", drive)
    frames = list(RecordingReader(tmp_path / "r.rrd").frames())
    for place, frame in enumerate(frames):
        latitude, longitude = frame.array(entities.MAP_EGO, "GeoPoints:positions", 2)[0]
        east, north = drive.pose(place).translation[:2]
        assert (latitude - 48.1374) * 111_200 == pytest.approx(north, abs=0.05)
        assert (longitude - 11.5755) * 111_320 * np.cos(np.radians(48.1374)) == pytest.approx(east, abs=0.1)
        assert len(frame.array(entities.MAP_BOXES, "GeoPoints:positions", 2)) == 2
    record(tmp_path / "none.rrd", MadeDrive(1))
    (frame,) = RecordingReader(tmp_path / "none.rrd").frames()
    assert not {entities.MAP_EGO, entities.MAP_BOXES} & set(frame.rows)


def test_the_rate_of_the_time_panel_is_that_of_the_drive():
    assert frame_rate_hz(MemoryDrive(5, step_s=0.5).stamps) == pytest.approx(2)
    assert frame_rate_hz(MemoryDrive(5, step_s=1 / 12).stamps) == pytest.approx(12)
    assert frame_rate_hz(MemoryDrive(1).stamps) == 2
