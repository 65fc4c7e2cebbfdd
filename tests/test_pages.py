"""README.md, docs/own-images.md, cameras-only.md, video.md, fine-tune.md, service.md, and the sample notebook run."""

import contextlib
import csv
import json
import random
import re
import shlex
import shutil
import threading
from base64 import b64encode
from http.client import HTTPConnection
from http.server import HTTPServer
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from command_line import MINI_TOML, command

import bevcli
from bevcli.published import read_sources
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.sequences.open import open_sequence

ROOT = Path(__file__).parents[1]
OWN_IMAGES = (ROOT / "docs/own-images.md").read_text()
OWN_BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", OWN_IMAGES, flags=re.MULTILINE | re.DOTALL)
OWN_COMMANDS = [line for name, block in OWN_BLOCKS if name == "sh" for line in block.splitlines()]


@pytest.fixture
def my_drive(tmp_path):
    """The sample with folders of cameras and names in microseconds. Times are up to 4 ms off, and one image is lost.

    The calibration is in YAML, and the poses are a table in seconds.
    """
    street, drive = ROOT / "samples/street", tmp_path / "my_drive"
    drive.mkdir()
    cameras = {}
    for name, camera in json.loads((street / "calibration.json").read_text())["cameras"].items():
        pose = camera["ego_from_camera"]
        rows = [[*row, shift] for row, shift in zip(pose["rotation"], pose["translation"], strict=True)]
        stated = {"K": camera["intrinsics"], "D": [0, 0, 0, 0], "T": [*rows, [0, 0, 0, 1]]}
        cameras[name.removeprefix("CAM_").lower()] = stated
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(cameras, sort_keys=False))
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    rows = [f"time,{','.join(names)}"]
    for row in csv.DictReader((street / "ego_motion.csv").read_text().splitlines()):
        rows.append(
            ",".join([f"{row['timestamp_ns'][:-9]}.{row['timestamp_ns'][-9:]}", *(row[name] for name in names)])
        )
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    generator = random.Random(0)
    for row in csv.DictReader((street / "frames.csv").read_text().splitlines()):
        for camera in (name for name in row if name.startswith("CAM_") and "." not in name):
            time = int(row["timestamp_ns"]) // 1000 + generator.randint(-4000, 4000)
            folder = drive / camera.removeprefix("CAM_").lower()
            folder.mkdir(exist_ok=True)
            if (camera, row["frame"]) != ("CAM_BACK", "7"):
                prefix = "CAM_FRONT_" if camera == "CAM_FRONT" else ""
                shutil.copy(street / row[camera], folder / f"{prefix}{time}.jpg")
    return drive


def test_the_note_of_the_page_is_said_and_the_conversion_follows_it(my_drive, tmp_path):
    stated = {"calibration": tmp_path / "cameras.yaml", "ego_motion_file": tmp_path / "poses.csv"}
    # The images tell the axes of the poses too, which takes seconds.
    axes = ["--pose-axes", "flu", "--pose-transform", "world_from_body", "--no-image-check"]
    one = open_sequence(my_drive, **stated, pose_axes="flu", pose_transform="world_from_body", image_check=False)
    shown = next(block for name, block in OWN_BLOCKS if "note: " in block)
    shown = " ".join(shown.split()).removeprefix("note: ").removesuffix(" …")
    said = next(note for note in one.notes if note.startswith("frames.csv"))
    within = re.compile(r"within \d+ ms")
    assert within.sub("", said).startswith(within.sub("", shown))
    assert int(within.search(said)[0].split()[1]) <= 8
    done = command(tmp_path, *shlex.split(next(line for line in OWN_COMMANDS if "convert" in line))[1:], *axes)
    assert done.returncode == 0, done.stderr
    other = open_sequence(tmp_path / "my_sequence")
    assert (tmp_path / "my_sequence/frames.csv").exists()
    assert [stamp.timestamp_ns for stamp in one.stamps] == [stamp.timestamp_ns for stamp in other.stamps]
    for place in (0, 7):
        a, b = one.load(place), other.load(place)
        times = [{name: image.timestamp_ns for name, image in frame.images.items()} for frame in (a, b)]
        assert times[0] == times[1]
        assert all(image.encoded == b.images[name].encoded for name, image in a.images.items())
    assert list(b.dropped) == ["back"]


@pytest.mark.slow
def test_the_commands_of_the_page_run(my_drive, tmp_path):
    assert len(OWN_IMAGES.splitlines()) < 50
    for line in OWN_COMMANDS:
        program, *arguments = shlex.split(line)
        assert program == "bevcli"
        if arguments[0] != "viz":  # which opens a viewer
            done = command(tmp_path, *arguments)
            assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    assert (tmp_path / "runs/my_drive-photographs/recording.rrd").exists()


CAMERAS_ONLY = (ROOT / "docs/cameras-only.md").read_text()
CAMERAS_COMMANDS = [shlex.split(line) for line in re.findall(r"^bevcli (.+)$", CAMERAS_ONLY, flags=re.MULTILINE)]


@pytest.fixture
def numbered_images(tmp_path):
    """my_drive with two numbered images of each camera of the sample, and a small model."""
    for camera in sorted((ROOT / "samples/street/images").iterdir()):
        own = tmp_path / "my_drive" / camera.name.removeprefix("CAM_").lower()
        own.mkdir(parents=True)
        for index, image in enumerate(sorted(camera.iterdir())[:2]):
            shutil.copy(image, own / f"image_{index:04d}.jpg")
    (tmp_path / "demo.toml").write_text(MINI_TOML)
    return tmp_path


@pytest.mark.slow
def test_the_commands_of_cameras_only_run(numbered_images):
    debug, run, viz = CAMERAS_COMMANDS
    done = command(numbered_images, *debug)
    assert done.returncode == 0, done.stderr
    assert "my_drive: 6 cameras" in done.stdout
    assert (numbered_images / "runs/my_drive-project-debug/cameras.png").exists()
    done = command(numbered_images, *run, "--model", "demo.toml", "--untrained", "--out", "runs/my_drive-photographs")
    assert done.returncode == 0, done.stderr
    assert "numbered images at 2 Hz, none of 12 images missing" in done.stderr
    assert command(numbered_images, *viz, "--summary").returncode == 0


VIDEO = (ROOT / "docs/video.md").read_text()
VIDEO_COMMANDS = re.findall(r"^bevcli (.+)$", VIDEO, flags=re.MULTILINE)
NUMBERS = ("--fov", "70", "--height", "1.4")


@pytest.fixture(scope="module")
def dashcam(tmp_path_factory):
    """dash.mp4 with three images of the front camera, and a small model in place of that of the page."""
    made = tmp_path_factory.mktemp("video")
    images = sorted((ROOT / "samples/street/images/CAM_FRONT").iterdir())[:3]
    writer = cv2.VideoWriter(str(made / "dash.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (800, 450))
    for path in images:
        writer.write(cv2.imread(str(path)))
    writer.release()
    (made / "demo.toml").write_text(MINI_TOML)
    return made


def test_the_video_runs_as_on_the_page(dashcam):
    [run] = [shlex.split(line) for line in VIDEO_COMMANDS if line.startswith("run ")]
    done = command(dashcam, *run, "--model", "demo.toml", "--untrained", "--out", "runs/dash-photographs", "--force")
    assert done.returncode == 0, done.stderr
    assert "without calibration: 1 camera" in done.stderr
    assert "no history is used" in done.stderr


@pytest.mark.slow
def test_the_video_is_checked_and_shown_as_on_the_page(dashcam):
    assert command(dashcam, *shlex.split(VIDEO_COMMANDS[0])).returncode == 0
    test_the_video_runs_as_on_the_page(dashcam)
    done = command(dashcam, *shlex.split(VIDEO_COMMANDS[-1], comments=True))
    assert done.returncode == 0, done.stderr
    assert (dashcam / "boxes.mp4").exists()
    assert (dashcam / "runs/dash-project-debug/cameras.png").exists()


@pytest.mark.parametrize("name", ["run", "project-debug"])
def test_a_video_alone_is_told_in_one_line_what_is_missing(dashcam, name):
    model = ("--model", "demo.toml", "--untrained") if name == "run" else ()
    done = command(dashcam, name, "dash.mp4", *model)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "pass `fov_deg=70` (`--fov 70`) and `height=1.5` (`--height 1.5`), or `calibration`" in done.stderr
    if name == "run":  # a converted video has the rig that was stated
        done = command(dashcam, "convert", "dash.mp4", "drive", *NUMBERS)
        assert done.returncode == 0, done.stderr
        assert len(list((dashcam / "drive/images/dash").iterdir())) == 3
        assert '"translation": [1.7, 0.0, 1.4]' in (dashcam / "drive/calibration.json").read_text()


def test_a_video_is_one_camera_of_a_calibration_by_its_name(dashcam):
    (dashcam / "CAM_FRONT.mp4").write_bytes((dashcam / "dash.mp4").read_bytes())
    own = ROOT / "samples/street/calibration.json"
    stated = json.loads(own.read_text())["cameras"]
    other = dashcam / "rig.json"
    other.write_text(json.dumps({name: {**each, "K": each.pop("intrinsics")} for name, each in stated.items()}))
    for calibration in (own, other):
        drive = bevcli.open_sequence(dashcam / "CAM_FRONT.mp4", calibration=calibration, ego_motion="static")
        assert drive.load(2).images["CAM_FRONT"].pixels_bgr.shape == (450, 800, 3)
        with pytest.raises(bevcli.BevcliError, match="name the video after its camera"):
            bevcli.open_sequence(dashcam / "dash.mp4", calibration=calibration, ego_motion="static")


FINE_TUNE = (ROOT / "docs/fine-tune.md").read_text()
FINE_TUNE_BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", FINE_TUNE, flags=re.MULTILINE | re.DOTALL)
OWN_NAMES = {"car": "PKW", "truck": "Lorry", "pedestrian": "person", "bicycle": "cyclist"}
SMALL = ["--steps", "1", "--set", "clips.batch=1", "--set", "clips.in_turn=1", "--set", "clips.frames=2"]


def make_drive(folder: Path, name: str) -> None:
    """A drive of four frames without ground truth, and the labels of a German spreadsheet."""
    street = ROOT / "samples" / "street"
    raw, labels = folder / "raw" / name, folder / "labels" / f"{name}.csv"
    shutil.copytree(street, raw, ignore=shutil.ignore_patterns("ground_truth*"))
    lines = (street / "frames.csv").read_text().splitlines()
    (raw / "frames.csv").write_text("\n".join(lines[:5]))
    labels.parent.mkdir(exist_ok=True)
    write_csv(read_boxes(street / "ground_truth.json"), labels)
    with labels.open(newline="") as file:
        header, *rows = csv.reader(file)
    kept = [row for row in rows if row[4] in OWN_NAMES and int(row[0]) < 4]
    table = [header, *([*row[:4], OWN_NAMES[row[4]], *row[5:]] for row in kept)]
    text = "".join(";".join(row).replace(".", ",") + "\r\n" for row in table)
    labels.write_bytes(("\ufeff" + text).encode())


@pytest.mark.slow
def test_the_page_leads_to_a_model_that_runs(tmp_path: Path) -> None:
    for name in ("monday", "tuesday", "friday"):
        make_drive(tmp_path, name)
    for language, block in FINE_TUNE_BLOCKS:
        if language == "toml":
            (tmp_path / "split.toml").write_text(block)
        for line in block.splitlines() if language == "sh" else ():
            arguments = shlex.split(line)[1:]
            small = SMALL if line.startswith("bevcli train --model") else []
            done = command(tmp_path, *arguments, *small)
            assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
            if small:
                assert all(f"{own} from {name}" in done.stdout for name, own in OWN_NAMES.items())
    with (tmp_path / "runs/friday-onnx/boxes.csv").open() as file:
        assert {row["class"] for row in csv.DictReader(file)} <= set(OWN_NAMES.values())
    assert (tmp_path / "my.onnx").is_file()


SERVICE = (ROOT / "docs/service.md").read_text()
STREET = ROOT / "samples/street"


@pytest.fixture
def service():
    """The program of the page, imported."""
    [program] = re.findall(r"^```python\n(.*?)^```", SERVICE, flags=re.MULTILINE | re.DOTALL)
    found = {"__name__": "drawing"}
    exec(compile(program, "drawing.py", "exec"), found)
    return SimpleNamespace(**found)


def post(port: int, body: object) -> tuple[int, bytes]:
    connection = HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("POST", "/", json.dumps(body))
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_the_service_draws_what_it_is_sent(service):
    service.Drawing.rig = bevcli.read_calibration(STREET / "calibration.json")
    service.Drawing.log_message = lambda *_: None
    server = HTTPServer(("127.0.0.1", 0), service.Drawing)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    front = (STREET / "images/CAM_FRONT/000000.jpg").read_bytes()
    status, drawn = post(server.server_port, {"CAM_FRONT": b64encode(front).decode()})
    image = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR)
    assert (status, image.shape) == (200, (640, 1920, 3))
    status, text = post(server.server_port, {"FRONT": b64encode(front).decode()})
    assert (status, text.decode().count("\n")) == (400, 0)
    assert "camera FRONT is not in the rig (it has CAM_FRONT, " in text.decode()
    cut = b64encode(front[:600]).decode()
    for body in ({"CAM_FRONT": ""}, {"CAM_FRONT": "not base64"}, {"CAM_FRONT": cut}, {"CAM_FRONT": 7}, [""]):
        status, text = post(server.server_port, body)
        assert (status, len(text.decode().splitlines())) == (400, 1), body
    server.shutdown()


README_BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", (ROOT / "README.md").read_text(), flags=re.MULTILINE | re.DOTALL)
OPENS_A_VIEWER = re.compile(r"^bevcli viz \S+$")


def readme_blocks(language: str) -> list[str]:
    return [block for name, block in README_BLOCKS if name == language]


@pytest.mark.parametrize("first", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["first block", "all"])
def test_the_commands_run(clone: Path, first: bool) -> None:
    lines = [line for block in readme_blocks("sh")[: 1 if first else None] for line in block.splitlines() if line]
    assert len(lines) > (2 if first else 5)
    for line in lines:
        program, *arguments = shlex.split(line)
        assert program == "bevcli"
        if not OPENS_A_VIEWER.match(line):
            done = command(clone, *arguments)
            assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"


@pytest.mark.slow
def test_the_python_example_writes_a_recording(clone: Path) -> None:
    [example] = readme_blocks("python")
    with contextlib.chdir(clone):
        exec(example, {})
    assert (clone / "street.rrd").stat().st_size > 100_000


def test_readme_and_weights_page_name_what_weights_list_does(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))  # without names of the user
    listed = list(read_sources())
    [names] = re.findall(r"^The names are (.*?)\. ", (ROOT / "README.md").read_text(), flags=re.MULTILINE | re.DOTALL)
    assert re.findall(r"`(.+?)`", names) == listed
    rows = re.findall(r"^\| `(.+?)` \|", (ROOT / "docs/weights.md").read_text(), flags=re.MULTILINE)
    assert rows == listed


@pytest.mark.slow
def test_the_notebook_runs(tmp_path):
    nbformat = pytest.importorskip("nbformat", reason="needs bevcli[notebook]")
    nbclient = pytest.importorskip("nbclient", reason="needs bevcli[notebook]")
    pytest.importorskip("rerun_notebook", reason="needs bevcli[notebook]")
    shutil.copy(ROOT / "samples" / "first_steps.ipynb", tmp_path)
    (tmp_path / "street").symlink_to(ROOT / "samples" / "street")
    notebook = nbformat.read(tmp_path / "first_steps.ipynb", as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/jpeg" in output.get("data", {}) for output in outputs) == 3
    assert sum("application/vnd.jupyter.widget-view+json" in output.get("data", {}) for output in outputs) >= 1
    assert any("NDS" in output.get("text", "") for output in outputs)
    assert (tmp_path / "first_steps" / "run" / "predictions.json").is_file()
