"""The views and `Prediction.plot`: legend, colours, range rings, camera views, titles, speed, street map, box lines."""

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import pytest
from made_boxes import made_boxes
from memory_drive import MemoryDrive, make_camera, make_rig
from recorded_drive import GRID, TINY, NamedModel, boxes_ahead, predict, record, recorded

from bevcli.errors import InputError
from bevcli.frame import MAP_CLASSES, MOST_MAP_CLASSES, BevMap, CameraImage, DriveFacts, class_bits
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import BOX_EDGES, Boxes3D
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, Camera, CameraRig, Distortion, default_ego_from_bev
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import GeoOrigin, apply, inverse
from bevcli.model.config import ModelConfig
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.blueprint import (
    TEXTS_SHARE,
    TITLE_HEIGHT,
    WINDOW,
    camera_row_shares,
    camera_rows,
    frame_rate_hz,
    rows_by_yaw,
)
from bevcli.recording.entities import (
    BACKGROUND,
    GROUND_TRUTH_COLOR,
    MAP_COLORS,
    MISSED_COLOR,
    OTHER_MAP_COLORS,
    class_colors,
    map_colors,
)
from bevcli.recording.log_cameras import (
    LETTER_HEIGHT,
    LETTER_WIDTH,
    NEAR_CLIP_M,
    ImageLines,
    PosedCamera,
    clip_near,
    clip_to_image,
    labels_in_image,
    lines_in_images,
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
    (frame,) = recorded(tmp_path / "r.rrd", drive, [(drive.load(0), predict(drive.load(0)))], Weights())
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
    step = drive.load(0), replace(predict(drive.load(0)), segmentation=maps)
    (frame,) = recorded(tmp_path / "r.rrd", drive, [step])
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
    step = drive.load(0), replace(predict(drive.load(0)), segmentation=maps)
    (frame,) = recorded(tmp_path / "r.rrd", drive, [step], NamedModel(config=config))
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


def test_cameras_are_in_rows_by_yaw():
    assert camera_rows(make_rig()) == (
        ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT"),
        ("CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT"),
    )
    assert camera_rows(make_rig({"only": 180})) == camera_rows(make_rig({"only": 10})) == (("only",),)
    yaws = {"left": 90, "rear": 180, "ahead": 0, "right": -90, "rear_right": -150, "rear_left": 150}
    rows = rows_by_yaw({name: np.radians(yaw) for name, yaw in yaws.items()})
    assert rows == (("left", "ahead", "right"), ("rear_left", "rear", "rear_right"))


FOUR = {"front": 0, "left": 90, "right": -90, "rear": 180}
RIGS = {
    "one": {"front": 0},
    "two": {"front": 0, "rear": 180},
    "three": {"left": 60, "right": -60, "rear": 180},
    "four": FOUR,
    "five": {"front": 0, "front_left": 55, "front_right": -55, "rear_left": 120, "rear_right": -120},
    "six": NUSCENES_YAWS_DEG,
    "seven": {**NUSCENES_YAWS_DEG, "tele": 1},
    "eight": {**FOUR, "front_left": 45, "front_right": -45, "rear_left": 135, "rear_right": -135},
}


def image_sizes(rig):
    """The width and height of each image in its view in the viewer's window, pixels."""
    sizes = {}
    for row, share in zip(camera_rows(rig), camera_row_shares(rig), strict=True):
        view = WINDOW[0] * (1 - TEXTS_SHARE) / len(row), share * WINDOW[1] - TITLE_HEIGHT
        for name in row:
            scale = min(view[0] / rig[name].width, view[1] / rig[name].height)
            sizes[name] = scale * rig[name].width, scale * rig[name].height
    return sizes


@pytest.mark.parametrize("rig", RIGS)
def test_all_images_of_a_rig_are_equally_large(rig):
    sizes = np.array(list(image_sizes(make_rig(RIGS[rig])).values()))
    assert sizes.min(axis=0) == pytest.approx(sizes.max(axis=0))
    assert 0.1 < sum(camera_row_shares(make_rig(RIGS[rig]))) < 0.7  # the middle keeps room
    assert sizes[0, 0] > 0.98 * min(WINDOW[0] * (1 - TEXTS_SHARE) / max(map(len, rows_by_yaw(RIGS[rig]))), 480)


def test_a_single_rear_camera_does_not_squeeze_the_others():
    sizes = image_sizes(make_rig(FOUR))
    assert min(height for _, height in sizes.values()) > 0.25 * WINDOW[1]
    assert sum(camera_row_shares(make_rig(FOUR))) < 0.63
    narrow = make_camera("rear", 180, width=180, height=320)
    rig = make_rig({"front": 0, "left": 60, "right": -60})
    sizes = image_sizes(CameraRig((*rig.cameras, narrow), rig.ego_from_bev))
    assert sizes["front"][1] > 0.2 * WINDOW[1]
    assert 0.25 * WINDOW[1] < sizes["rear"][1] < 0.63 * WINDOW[1]


def test_few_or_square_images_share_one_row():
    assert camera_rows(make_rig(RIGS["two"])) == (("front", "rear"),)
    assert camera_rows(make_rig(RIGS["three"])) == (("left", "right", "rear"),)
    square = tuple(make_camera(name, yaw, width=320, height=320) for name, yaw in FOUR.items())
    assert camera_rows(CameraRig(square, default_ego_from_bev())) == (("left", "front", "right", "rear"),)


def test_labels_do_not_overlap_and_the_largest_box_wins():
    boxes = np.array([[100, 100, 30], [110, 100, 90], [500, 100, 60], [600, 300, 2]])  # x, y, height
    segments = np.array([[[x, y], [x + 5, y + h]] for x, y, h in boxes], dtype=float)
    centers, owners = labels_in_image(ImageLines(segments, np.arange(4)), ["car 0.50"] * 4, 800, 450)
    assert owners.tolist() == [1, 2]  # the first is covered by the second, the last is too small
    size = np.array([8 * LETTER_WIDTH * 800, LETTER_HEIGHT * 450])
    assert (np.abs(centers[0] - centers[1]) >= size - 1e-9).any()
    assert (centers - size / 2)[:, 0].min() >= -1e-9


def test_the_labels_of_the_legend_begin_at_their_colours(tmp_path):
    """Letters are at most 0.3 units wide."""
    record(tmp_path / "r.rrd", MemoryDrive(1))
    (frame,) = RecordingReader(tmp_path / "r.rrd").frames()
    colors, texts = (frame.array(f"{entities.LEGEND}/{kind}", "Points2D:positions", 2) for kind in ("colors", "texts"))
    halves = np.array([len(text) for text in frame.texts(f"{entities.LEGEND}/texts", "Points2D:labels")]) * 0.15
    starts = texts[:, 0] - halves - colors[:, 0]
    assert len(starts) > 10
    assert (starts > -0.1).all()
    assert (starts < 1.0).all()


FINE = 256  # cv2.clipLine takes integers: subdivide the pixels
CAMERA = Camera("front", 640, 360, np.array([[400.0, 0, 320], [0, 400, 180], [0, 0, 1]]), np.eye(4))
AT_ORIGIN = PosedCamera(CAMERA, np.eye(4), np.eye(4))


def one_box(center, size=(2.0, 2.0, 2.0)) -> Boxes3D:
    """In the camera frame: z is ahead."""
    return made_boxes([center], sizes_lwh=size)


def test_lines_are_clipped_as_by_opencv():
    random = np.random.default_rng(1)
    segments = random.integers(-400, 1000, (400, 2, 2)).astype(float)
    clipped, kept = clip_to_image(segments, 640, 360)
    for segment, ours, is_kept in zip(segments, clipped, kept, strict=True):
        start, end = (segment * FINE).astype(int).tolist()
        inside, start, end = cv2.clipLine((0, 0, 640 * FINE + 1, 360 * FINE + 1), start, end)
        if not inside:
            assert not is_kept or np.linalg.norm(ours[0] - ours[1]) < 0.1
        elif np.linalg.norm(np.subtract(start, end)) > FINE / 10:
            assert is_kept
            np.testing.assert_allclose(ours, np.array([start, end]) / FINE, atol=0.1)


def test_a_line_through_the_camera_is_cut_at_the_near_plane():
    ends, before = clip_near(np.array([[[0.0, 0, -1], [0, 0, 3]], [[0, 0, -1], [0, 0, -2]]]))
    assert before.tolist() == [True, False]
    np.testing.assert_allclose(ends[0], [[0, 0, NEAR_CLIP_M], [0, 0, 3]])


def test_a_box_around_the_camera_stays_inside_the_image():
    lines = lines_in_images(one_box((2, 0, 0), (6, 6, 6)).corners(), [AT_ORIGIN])[0]
    assert len(lines.segments)
    assert lines.segments.min() >= -1e-9
    assert (lines.segments <= [640 + 1e-9, 360 + 1e-9]).all()
    assert not len(lines_in_images(one_box((0, 0, -10)).corners(), [AT_ORIGIN])[0].segments)  # behind the camera


def test_a_box_ahead_is_where_the_pinhole_model_projects_it():
    lines = lines_in_images(one_box((0, 0, 10)).corners(), [AT_ORIGIN])[0]
    # Its nearest face is 9 m away and 2 m wide: 400 px/m at 1 m, 44.4 px at 9 m to each side.
    np.testing.assert_allclose(lines.segments.reshape(-1, 2).max(0), [320 + 400 / 9, 180 + 400 / 9])
    assert set(lines.owners) == {0}


def test_every_box_of_which_an_edge_is_inside_the_image_is_drawn():
    random = np.random.default_rng(0)
    count = 400
    sizes, yaws = random.uniform(0.5, 12, (count, 3)), random.uniform(-np.pi, np.pi, count)
    boxes = Boxes3D(random.normal(size=(count, 3)) * 12, sizes, yaws, np.zeros((count, 2)), np.array(["car"] * count))
    (lines,) = lines_in_images(boxes.corners(), [AT_ORIGIN])
    shares = np.linspace(0, 1, 200)[:, None]
    expected = set()
    for index, corners in enumerate(boxes.corners()):
        for start, end in BOX_EDGES:
            x, y, z = (corners[start] + shares * (corners[end] - corners[start])).T
            ahead = z > NEAR_CLIP_M
            u, v = 320 + 400 * x[ahead] / z[ahead], 180 + 400 * y[ahead] / z[ahead]
            if ((u > 0) & (u < 640) & (v > 0) & (v < 360)).any():
                expected.add(index)
    assert 50 < len(expected) < 350
    assert expected <= set(lines.owners)


def test_a_distorted_edge_is_curved():
    lens = Distortion("brown_conrady", (-0.3, 0.05, 0.0, 0.0))
    box = one_box((0, 2.2, 8), (7.0, 0.5, 0.5))
    lines = lines_in_images(box.corners(), [replace(AT_ORIGIN, camera=replace(CAMERA, distortion=lens))])[0]
    corners = box.corners()[0, :4]
    middle = (corners[0] + corners[1]) / 2
    numbers = CAMERA.intrinsics, np.array(lens.coefficients)
    expected, _ = cv2.projectPoints(middle[None], np.zeros(3), np.zeros(3), *numbers)
    away = np.linalg.norm(lines.segments.reshape(-1, 2) - expected.reshape(2), axis=-1).min()
    straight = np.array([CAMERA.project(c)[0] for c in corners[:2]]).mean(0)
    assert away < 1.5
    assert np.linalg.norm(straight - expected.reshape(2)) > 3


SEQUENCE = MemoryDrive(1)


@pytest.fixture(scope="module")
def prediction():
    """The known boxes, on grey images."""
    frame = SEQUENCE.load(0)
    grey = {name: CameraImage(0, np.full_like(image.pixels_bgr, 90)) for name, image in frame.images.items()}
    return replace(predict(frame), frame=replace(frame, images=grey))


def of_color(image, name):
    """(H, W) bool, the pixels in about the colour of a class: lines are smoothed."""
    color = NUSCENES_CLASSES[name].color
    return (np.abs(image.astype(int) - color[::-1]) < 80).all(-1)


def test_a_box_is_drawn_where_opencv_projects_it(prediction):
    image = prediction.plot("CAM_FRONT")
    camera, frame = SEQUENCE.rig["CAM_FRONT"], prediction.frame
    assert image.shape == (camera.height, camera.width, 3)
    camera_from_bev = inverse(camera.ego_from_camera) @ frame.rig.ego_from_bev
    corners = apply(camera_from_bev, boxes_ahead().corners()[0])
    pixels = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), camera.intrinsics, None)[0][:, 0]
    top = int(pixels[:, 1].min())
    rows, columns = np.nonzero(of_color(image, "car")[top:])  # its label is above
    assert (columns.min(), columns.max()) == pytest.approx((pixels[:, 0].min(), pixels[:, 0].max()), abs=2)
    assert top + rows.max() == pytest.approx(pixels[:, 1].max(), abs=2)
    assert (image[:20, -40:] == 90).all()  # the image itself, beside the boxes
    of_the_bus = np.s_[60:, :90]
    assert (image[of_the_bus] == 90).all()  # its score is 0.1
    assert (prediction.plot("CAM_FRONT", score=0.05)[of_the_bus] != 90).any()


def test_the_map_from_above_shows_boxes_and_areas(prediction):
    cells = np.zeros((20, 20), np.uint8)
    cells[0, 19] = 1  # ahead to the right
    area = BevMap(cells, GRID.x_range_m, GRID.y_range_m, {"drivable_road": 1})
    image = replace(prediction, segmentation=area).plot()
    assert image.shape == (640, 1920, 3)
    above = image[:, 1280:]
    half = 1.02 * GRID.y_range_m[1]  # of the view, metres
    car = boxes_ahead().centers[0]
    rows, columns = np.nonzero(of_color(above, "car"))
    assert np.median(columns) == pytest.approx(320 * (1 + car[0] / half), abs=12)
    assert rows.max() == pytest.approx(320 * (1 - (car[1] - 4.5 / 2) / half), abs=4)
    assert tuple(above[20, 620]) == (75, 64, 58)  # the road
    assert tuple(above[20, 20]) != (75, 64, 58)


def test_images_of_an_untrained_model_say_so(prediction):
    trained, random = prediction.plot("CAM_BACK"), replace(prediction, untrained=True).plot("CAM_BACK")
    assert np.array_equal(trained[:150], random[:150])
    warning = (random == (85, 70, 255)).all(-1)
    assert warning[150:].sum() > 20
    assert not (trained == (85, 70, 255)).all(-1).any()
    assert np.array_equal(prediction.plot(color_order="rgb"), prediction.plot()[..., ::-1])
    frame = prediction.frame
    kept = {name: image for name, image in frame.images.items() if name != "CAM_FRONT"}
    image = replace(prediction, frame=replace(frame, images=kept)).plot("CAM_FRONT")
    assert (image[-20:] == (25, 20, 18)).all()  # a missing image leaves its place dark
    assert not of_color(image, "car").any()


def test_mistakes_in_the_arguments_of_a_plot_are_named(prediction):
    with pytest.raises(InputError, match=r"`image=FRONT`: is not a camera of the rig \(it has CAM_FRONT, "):
        prediction.plot("FRONT")
    with pytest.raises(InputError, match='expected "bgr" or "rgb"'):
        prediction.plot(color_order="hsv")
    with pytest.raises(InputError, match="has no frame"):
        replace(prediction, frame=None).plot()
