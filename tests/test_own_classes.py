"""A model with classes of its own, from its TOML file to scores, tracks and exports."""

import json
from pathlib import Path

import numpy as np
import pytest
from made_boxes import made_boxes

from bevcli.config import as_table, config_of_table, load_config
from bevcli.errors import ConfigError, InputError
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.geometry.cameras import Camera
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ClassSettings, are_nuscenes, object_classes
from bevcli.inference.tracking import TrackerConfig
from bevcli.recording.entities import class_colors
from bevcli.sequences.files.boxes_file import ClassNames
from bevcli.workshop.formats.kitti import kitti_labels
from bevcli.workshop.scores.detection import DetectionConfig
from bevcli.workshop.scores.evaluate import evaluate
from bevcli.workshop.scores.tracking import TrackingConfig

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
