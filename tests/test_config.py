"""Model files and the registry: how values are read, classes of one's own, and one clear line for each mistake."""

import json
import re
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pytest
from command_line import invoked
from made_boxes import made_boxes

from bevcli import registry
from bevcli.config import TRAINING, as_table, config_of_table, known_models, load_config, load_table, read_model_file
from bevcli.errors import BevcliError, ConfigError, InputError, WeightsError
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.geometry.cameras import Camera
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ClassSettings, are_nuscenes, object_classes
from bevcli.inference.tracking import TrackerConfig
from bevcli.published import named_weights
from bevcli.recording.entities import class_colors
from bevcli.registry import OWN, Group
from bevcli.sequences.files.boxes_file import ClassNames
from bevcli.workshop.bevformer_v2 import BEVFormerV2Config
from bevcli.workshop.formats.kitti import kitti_labels
from bevcli.workshop.scores.detection import DetectionConfig
from bevcli.workshop.scores.evaluate import evaluate
from bevcli.workshop.scores.tracking import TrackingConfig
from bevcli.workshop.uniad.uniad import UniADConfig


@dataclass(frozen=True)
class Wheel:
    width: float
    kind: Literal["summer", "winter"] = "summer"


@dataclass(frozen=True)
class Car:
    name: str
    wheel: Wheel
    seats: int = 4
    doors: tuple[int, ...] = ()
    size: tuple[float, float] = (4.0, 2.0)
    roof: Literal["open"] | tuple[float, float] = "open"
    towed: tuple[int, int] | None = None
    spare: Wheel = field(default_factory=lambda: Wheel(1.0))
    electric: bool = False

    def __post_init__(self) -> None:
        if self.seats < 1:
            raise ValueError("seats must be positive")


def load(folder: Path, text: str) -> Car:
    """The training table of a file car.toml, read as a Car."""
    path = folder / "car.toml"
    path.write_text(f"[training]\n{text}")
    return load_table(path, TRAINING, Car)


MINIMAL = 'name = "a"\n{}\n[training.wheel]\nwidth = 1'


@pytest.mark.parametrize(
    ("name", "cells", "layers", "levels", "padded"),
    [("tiny", 50, 3, 1, (800, 480)), ("small", 150, 3, 1, (1280, 736)), ("base", 200, 6, 4, (1600, 928))],
)
def test_the_published_models_have_the_published_sizes(
    name: str, cells: int, layers: int, levels: int, padded: tuple[int, int]
) -> None:
    config = load_config(name)
    assert (config.bev_grid.rows, config.bev_grid.columns) == (cells, cells)
    assert (config.encoder.layers, config.neck.levels, config.image.padded_size) == (layers, levels, padded)
    assert config.name == name
    assert config.ego_motion.history_shift == "both"
    if name == "tiny":  # a name of published weights names their model
        assert read_model_file("tiny-fp16")[0] == read_model_file("tiny")[0] | {"name": "tiny-fp16"}


def test_values_are_converted_to_the_types_of_the_dataclass(tmp_path: Path) -> None:
    text = 'name = "a"\ndoors = [2, 3]\nsize = [4, 2.5]\nroof = [1, 2]\ntowed = [1, 1]\nwheel = { width = 3 }'
    car = load(tmp_path, text)
    assert car == Car("a", Wheel(3.0), doors=(2, 3), size=(4.0, 2.5), roof=(1.0, 2.0), towed=(1, 1))
    assert isinstance(car.wheel.width, float)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MINIMAL.format("seets = 3"), 'car.toml: unknown key "training.seets"; did you mean "seats"?'),
        (MINIMAL.format("") + "\nwidht = 2", 'car.toml: unknown key "training.wheel.widht"; did you mean "width"?'),
        ('name = "a"', 'car.toml: "training.wheel" is missing; expected a table'),
        (MINIMAL.format("seats = 2.5"), 'car.toml: "training.seats" must be an integer, but is 2.5'),
        (MINIMAL.format("seats = true"), 'car.toml: "training.seats" must be an integer, but is True'),
        (MINIMAL.format("electric = 1"), 'car.toml: "training.electric" must be true or false, but is 1'),
        (MINIMAL.format("size = [1.0]"), '"training.size" must be a list of 2, each element a number, but is [1.0]'),
        (MINIMAL.format("size = [1, nan]"), "each element a number, but is [1, nan]"),
        (MINIMAL.format('doors = ["x"]'), "\"training.doors\" must be a list, each element an integer, but is ['x']"),
        (MINIMAL.format('roof = "shut"'), '"training.roof" must be "open" or a list of 2, each element a number'),
        (MINIMAL.format("wheel2 = 1"), 'unknown key "training.wheel2"; did you mean "wheel"?'),
        ('name = "a"\nwheel = 3', 'car.toml: "training.wheel" must be a table, but is 3'),
        (MINIMAL.format("") + '\nkind = "all"', '"training.wheel.kind" must be "summer" or "winter", but is \'all\''),
        (MINIMAL.format("seats = 0"), "car.toml: [training]: seats must be positive"),
        ("name = ", "car.toml: invalid TOML"),
    ],
)
def test_the_error_for_a_mistake_is_one_line_with_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        load(tmp_path, text)


# By the name of a known model: a text of its file, what stands there instead, and the message.
WRONG = {
    "tiny": [
        ("channels = 256", "channels = 250", "channels is 250"),
        ("spatial_points = 8", "spatial_points = 6", "encoder.spatial_points must be a multiple"),
        ("levels = 1", "levels = 5", "neck.levels is 5"),
        ("output_stages = [4]", "output_stages = [5]", "[backbone]: output_stages"),
        ("rows = 50", "rows = 0", '"bev_grid.rows" must be an integer of 1 or more, but is 0'),
        ("attention_heads = 8", "attention_heads = 0", '"encoder.attention_heads" must be an integer of 1 or more'),
        ("queries = 900", "queries = 0", '"decoder.queries" must be an integer of 1 or more, but is 0'),
        ("x_range_m = [-51.2, 51.2]", "x_range_m = [51.2, -51.2]", "each range goes from a smaller"),
        ("rate_hz = 2.0", "rate_hz = 0", '"rate_hz" must be a number above 0, but is 0'),
        ("blocks = [3, 4, 6, 3]", "blocks = [3, 0, 6, 3]", '"backbone.blocks" must be a list of 4, each element'),
        ("queries = 900", "fade_duplicates = 1.1", "a number from 0 to 1, but is 1.1"),
        ("queries = 900", "merge_duplicates = inf", "a number of 0 or more, but is inf"),
        ('heads = ["detection"]', 'heads = ["detektion"]', '"heads" must be'),
        ("channels = 256", "channels = 96000000000000000", "channels is 96000000000000000 (expected at most 4096)"),
        ("channels = 256", "channels = 960000", "channels is 960000 (expected at most 4096)"),
        ("rows = 50", "rows = 1000000", "bev_grid.rows is 1000000 (expected at most 2000)"),
        ("columns = 50", "columns = 1000000", "bev_grid.columns is 1000000"),
        ("queries = 900", "queries = 4000000000", "decoder.queries is 4000000000"),
        ("blocks = [3, 4, 6, 3]", "blocks = [3, 4, 6, 1000000]", "backbone.blocks is 1000000"),
        ("[neck]", "width = 1000000\n[neck]", "backbone.width is 1000000"),
        ("[encoder]\nlayers = 3", "[encoder]\nlayers = 3000000", "encoder.layers is 3000000"),
        ("queries = 900", "querys = 900", 'unknown key "decoder.querys"; did you mean "queries"?'),
    ],
    "uniad-track-map": [
        ("keep_score = 0.35", "keep_score = 0.45", "[track_queries]: keep_score must not be above birth_score"),
        ("max_misses = 5", "max_misses = 0", '"track_queries.max_misses" must be an integer of 1 or more'),
        ('box_z = "bottom"', 'box_z = "top"', '"track_queries.box_z" must be "center" or "bottom"'),
        ("queries = 901", "queries = 1", "decoder.queries must be at least 2"),
        ('["detection"]', '["detection", "segmentation"]', 'heads must be ["detection"]'),
    ],
    "v2-t2": [
        ('"BEVFormerV2"', '"BEVFormerV3"', '"BEVFormerV2" or "UniAD" or "VAD", but is \'BEVFormerV3\''),
        ("frames = [-1, 0]", "", '"frames" is missing; expected a list, each element'),
        ("frames = [-1, 0]", "frames = [-2, -1]", "frames must be ascending, and hold 0, the current frame"),
        ("can_bus = false", "can_bus = true", "ego_motion: can_bus, shift and rotation must be false"),
        ("frames = [-1, 0]", "frames = [-1, 0]\nhorizon = true", "horizon and hybrid_queries must be left out"),
        ("260, 1600, 900]", "260, 1600, 901]", "crop must be left, top, right, bottom inside size"),
        ('architecture = "BEVFormerV2"', "", 'unknown key "f'),
    ],
}


@pytest.mark.parametrize(
    ("model", "old", "new", "message"), [(model, *row) for model, rows in WRONG.items() for row in rows]
)
def test_values_that_do_not_fit_each_other_are_an_error(
    tmp_path: Path, model: str, old: str, new: str, message: str
) -> None:
    text = (Path(__file__).parents[1] / "bevcli" / "configs" / f"{model}.toml").read_text()
    assert old in text
    (tmp_path / "mine.toml").write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=rf"mine\.toml.*{re.escape(message)}"):
        load_config(tmp_path / "mine.toml")


@pytest.mark.parametrize("name", ["huge", "nowhere/x.toml"])
def test_the_error_for_an_unknown_model_names_the_known_ones(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"base.*small.*tiny"):
        load_config(name)
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"bytes\.toml: cannot be read"):
        load_config(tmp_path / "bytes.toml")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("backbone", 3, '"backbone" must be a table, but is 3'),
        ("backbone", {"kind": []}, '"backbone.kind" must be "resnet" or '),
        ("image_detector", {"kind": {}}, '"image_detector.kind" must be "nanodet", but is {}'),
        ("hybrid_queries", {"count": 5, "features": 64}, "features must be the channels of the detector's maps, 128"),
    ],
)
def test_a_wrong_table_of_a_model_is_named(key: str, value: object, message: str) -> None:
    contents = as_table(load_config("photographs"))
    with pytest.raises(ConfigError, match=re.escape(message)):
        config_of_table({**contents, key: value}, "car.toml")


def test_the_architecture_of_a_file_is_named() -> None:
    uniad, config = load_config("uniad-track-map"), load_config("v2-t2")
    assert isinstance(uniad, UniADConfig)
    assert uniad.map_classes == ("drivable_area", "divider", "pedestrian_crossing", "contour")
    assert isinstance(config, BEVFormerV2Config)
    assert (config.frames, config.image.padded_size, config.encoder_levels) == ((-1, 0), (1600, 640), 4)


@pytest.mark.parametrize("name", known_models())
def test_a_model_files_contents_come_back_from_its_configuration(name: str) -> None:
    config = load_config(name)
    contents = json.loads(json.dumps(as_table(config)))
    assert config_of_table(contents, name) == config


GROUP = "bevcli.sequences"


@pytest.fixture
def installed(monkeypatch):
    """Makes the given (name, object) the entry points of a group."""

    def install(*entries, group=GROUP):
        found = [EntryPoint(name, value, group) for name, value in entries]
        monkeypatch.setattr(registry, "installed", lambda: EntryPoints(found))
        registry.entries.cache_clear()
        registry.load.cache_clear()

    yield install
    monkeypatch.undo()
    registry.entries.cache_clear()
    registry.load.cache_clear()


@pytest.mark.parametrize("group", get_args(Group))
def test_own_entries_need_no_metadata_of_an_installation(group, installed):
    installed()
    assert list(registry.entries(group)) == sorted(OWN[group])
    assert all(registry.load(group, name) is not None for name in OWN[group])


def test_an_entry_that_cannot_be_imported_is_named(installed):
    installed(("good", "json:loads"), ("bad", "a_package_that_is_missing:FORMAT"))
    assert registry.load(GROUP, "good")("[1]") == [1]
    with pytest.raises(BevcliError, match=r"bad = a_package_that_is_missing:FORMAT cannot be imported"):
        registry.load(GROUP, "bad")
    with pytest.raises(BevcliError, match=r'"lidar" is unknown .expected .*, native, nuscenes, ros, '):
        registry.load(GROUP, "lidar")
    # Metadata of an earlier version of bevcli are ignored.
    installed(("native", "bevcli.native:FORMAT"), ("gone", "bevcli.sequences.gone:FORMAT"))
    assert list(registry.entries(GROUP)) == sorted(OWN[GROUP])
    assert registry.load(GROUP, "native").expected


def test_two_packages_with_the_same_name_are_refused(installed):
    installed(("one", "json:loads"), ("one", "json:dumps"))
    with pytest.raises(BevcliError, match='two packages register "one"'):
        registry.entries(GROUP)
    installed(("one", "json:loads"), ("one", "json:loads"))
    assert list(registry.entries(GROUP)) == sorted([*OWN[GROUP], "one"])
    installed(("ros", "json:loads"))
    with pytest.raises(BevcliError, match=r'two packages register "ros": bevcli.workshop.formats:BagOptions and json:'):
        registry.entries(GROUP)


def test_a_broken_command_of_a_package_costs_a_warning(installed):
    installed(("broken", "a_package_that_is_missing:run"), group="bevcli.commands")
    shown = invoked("--help")
    assert "  export " in shown.stdout
    assert "  broken " not in shown.stdout
    (warning,) = shown.stderr.splitlines()
    assert re.match("warning: .*broken = a_package_that_is_missing:run cannot be imported: ", warning)
    invoked("export", "--help")
    with pytest.raises(BevcliError, match="a_package_that_is_missing:run cannot be imported"):
        invoked("broken")


def test_the_folder_of_a_packed_model_is_named_as_the_hub_names_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("packed").mkdir()
    with pytest.raises(ConfigError, match=r'unknown model "packed".*the folder is named "hf:\./packed"'):
        load_config("packed")
    with pytest.raises(WeightsError, match='the weights of "photographs" are in the package'):
        named_weights("photographs")


NAMES = ("PKW", "Lorry", "person", "deer")
SETTINGS = {"PKW": {"like": "car", "range_m": 60.0}, "Lorry": {"like": "truck"}, "person": {"like": "pedestrian"}}
CLASSES = object_classes(NAMES, {name: ClassSettings(**each) for name, each in SETTINGS.items()})


def table(**changes) -> dict:
    return as_table(load_config("demo")) | {"classes": list(NAMES), "class_settings": SETTINGS} | changes


def boxes(*names: str, scores: float | None = None) -> Boxes3D:
    places = [(10.0 + 8 * place, 0.0, 1.0) for place in range(len(names))]
    return made_boxes(places, names, sizes_lwh=2.0, velocities=3.0, scores=scores)


def frames(names: tuple[str, ...], score: float | None = None) -> list[dict]:
    def one(index: int, name: str) -> dict:
        box = {"class": name, "center": [10.0 + 8 * index, 0.0, 1.0], "size_lwh": [4.0, 2.0, 1.5], "yaw": 0.0}
        return box | ({} if score is None else {"score": score})

    return [{"frame": 0, "timestamp_ns": 0, "boxes": [one(index, name) for index, name in enumerate(names)]}]


def write(path: Path, names: tuple[str, ...], score: float | None = None, **head) -> Path:
    content = {"format": "bevcli-boxes/1", "frame_of_reference": "ego", **head, "frames": frames(names, score)}
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"classes": [], "class_settings": {}}, "classes is empty"),
        ({"classes": ["car", "car"], "class_settings": {}}, '"car" stands there twice'),
        ({"classes": ["a\nb"], "class_settings": {}}, "is not a name"),
        ({"class_settings": {"bus": {}}}, 'class_settings: "bus" is not among the classes'),
        ({"class_settings": {"PKW": {"like": "cra"}}}, r"\[class_settings.PKW\]: like is \"cra\""),
        ({"class_settings": {"PKW": {"range": 5}}}, 'unknown key "class_settings.PKW.range"; did you mean "range_m"'),
        ({"class_settings": {"PKW": {"color": "red"}}}, 'color is "red"'),
    ],
)
def test_wrong_classes_are_one_clear_line(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config_of_table(table(**changes), "my.toml")


def test_a_models_file_states_its_classes_and_ten_keep_nuscenes_parameters() -> None:
    config = config_of_table(table(), "my.toml")
    assert config.object_classes == CLASSES
    assert (CLASSES["PKW"].range_m, CLASSES["PKW"].gate_m) == (60.0, NUSCENES_CLASSES["car"].gate_m)
    assert config_of_table(as_table(config), "my.toml") == config
    assert DetectionConfig.of(NUSCENES_CLASSES) == DetectionConfig()
    assert TrackingConfig.of(NUSCENES_CLASSES) == TrackingConfig()
    names = ["bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck"]
    assert list(TrackingConfig().class_ranges_m) == names
    assert are_nuscenes(load_config("demo").object_classes)
    assert not are_nuscenes(CLASSES)


def test_predictions_are_scored_with_their_own_classes(tmp_path: Path) -> None:
    head = {"classes": list(NAMES), "class_settings": SETTINGS}
    found = write(tmp_path / "p.json", ("PKW", "Lorry", "person"), 0.9, **head)
    truth = write(tmp_path / "t.json", ("pkw", "LKW", "person", "deer"))
    scores = evaluate(found, truth, class_map={"LKW": "Lorry"})
    assert list(scores.detection.overall.classes) == list(NAMES)
    assert [each.mean_ap for each in scores.detection.overall.classes.values()] == pytest.approx([1, 1, 1, 0])
    assert any("not comparable to nuScenes'" in note for note in scores.notes)
    with pytest.raises(InputError, match=r'"truck" is not a class \(expected one of PKW, Lorry, person, deer'):
        evaluate(found, truth, class_map={"LKW": "truck"})
    scores = evaluate(write(tmp_path / "p.json", ("deer",), 0.9, classes=["deer"]), write(truth, ("deer",)))
    assert np.isnan(scores.detection.overall.errors["attr_err"])  # a class without attributes has no such error
    assert scores.detection.overall.mean_ap == pytest.approx(1)
    assert CLASSES["deer"].undefined_errors == ("attr_err",)
    wrong = write(tmp_path / "p.json", ("PKW",), 0.9, classes=["PKW", "PKW"])
    with pytest.raises(InputError, match=r'p\.json: "classes" or "class_settings" is wrong: .* twice'):
        evaluate(wrong, wrong)


def test_attributes_gates_and_types_follow_the_class_it_is_like() -> None:
    some = boxes(*NAMES)
    assert attributes_by_speed(some, CLASSES).tolist() == ["vehicle.moving", "vehicle.moving", "pedestrian.moving", ""]
    tracker = TrackerConfig(gates_m={"deer": 6.0}).for_classes(CLASSES)
    assert [tracker.gates_m[name] for name in some.classes] == [3.0, 3.0, 2.0, 6.0]
    with pytest.raises(ValueError, match="has no class"):
        TrackerConfig(gates_m={"cow": 6.0}).for_classes(CLASSES)
    ahead = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]], float)
    camera = Camera("front", 800, 450, np.array([[400.0, 0, 400], [0, 400, 225], [0, 0, 1]]), ahead)
    kinds = [line.split()[0] for line in kitti_labels(some, camera, CLASSES)]
    assert kinds == ["Car", "Truck", "Pedestrian", "deer"]


def test_every_class_has_a_colour_of_its_own() -> None:
    twins = object_classes(("PKW", "Kombi"), {name: ClassSettings(like="car") for name in ("PKW", "Kombi")})
    colors = class_colors(twins.values())
    assert colors["PKW"] != colors["Kombi"]
    red = object_classes(("PKW",), {"PKW": ClassSettings(color="#102030")})
    assert class_colors(red.values()) == {"PKW": (16, 32, 48)}


def test_names_are_compared_to_the_models_classes() -> None:
    names = ClassNames({"LKW": "lorry"}, NAMES)
    renamed = names.renamed(boxes("pkw", "lkw", "Person", "bus"))
    assert renamed.classes.tolist() == ["PKW", "Lorry", "person", "bus"]
    (note,) = names.note({"bus": 3, "PKW": 2}, "my_drive")
    assert note.startswith("my_drive: 3 boxes have other classes and are not scored: bus (3)")
    assert "bus=PKW" in note
