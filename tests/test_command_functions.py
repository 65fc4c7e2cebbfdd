"""What the commands do, as functions: they take the options as keywords, and return what the commands print."""

from pathlib import Path

import numpy as np
import pytest
from command_line import MINI_TOML
from small_fleet import write_fleet

import bevcli
from bevcli.errors import BevcliError, InputError, OutputError
from bevcli.options import gather, refuse, spread
from bevcli.workshop.formats import LabelOptions, WriteOptions
from bevcli.workshop.synth import DriveOptions

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small drives with ground truth, a model file, and the run of one of them."""
    folder = tmp_path_factory.mktemp("functions")
    (folder / "mini.toml").write_text(MINI_TOML)
    write_fleet(folder / "drives", 2, frames=3, truth=True)
    return folder


def test_convert_returns_what_was_written(folder: Path, tmp_path: Path) -> None:
    source = folder / "drives/d000"
    converted = bevcli.convert(source, tmp_path / "copy")
    assert str(converted) == f"{tmp_path / 'copy'}: 3 frames, 6 cameras"
    assert (converted.frames, converted.missing, converted.notes) == (3, 0, ())
    copy, original = bevcli.open_sequence(tmp_path / "copy").load(1), bevcli.open_sequence(source).load(1)
    assert np.array_equal(copy.images["CAM_BACK"].pixels_bgr, original.images["CAM_BACK"].pixels_bgr)
    with pytest.raises(OutputError, match="exists already"):
        bevcli.convert(source, tmp_path / "copy")
    one = bevcli.convert(source, tmp_path / "copy", force=True, frames=slice(0, 1))
    assert one.frames == 1
    with pytest.raises(InputError, match="unknown format"):
        bevcli.convert(source, tmp_path / "other", form="vhs")
    target, what = bevcli.export(source / "ground_truth.json", form="csv", out=tmp_path / "boxes.csv")
    assert (target, what) == (tmp_path / "boxes.csv", "6 boxes")
    assert len(target.read_text().splitlines()) == 7


def test_a_batch_is_a_function_of_drives_and_options(folder: Path, tmp_path: Path) -> None:
    drives, options = str(folder / "drives/*"), {"model": str(folder / "mini.toml"), "untrained": True, "count": 1}
    summary = bevcli.batch(drives, tmp_path / "out", evaluate=True, level="minimal", **options)
    assert (summary.drives, summary.failed, summary.stopped) == (2, 0, False)
    assert (tmp_path / "out/metrics.json").is_file()
    again = bevcli.batch([drives], tmp_path / "out", resume=True, evaluate=True, level="minimal", **options)
    assert again.skipped == 2
    with pytest.raises(TypeError, match=r"batch\(\) has no option speed"):
        bevcli.batch(drives, tmp_path / "out", speed=3)
    with pytest.raises(InputError, match=r"`retry_failed` \(`--retry-failed`\): is for `resume=True`"):
        bevcli.batch(drives, tmp_path / "out", retry_failed=True, **options)


@pytest.mark.slow
def test_train_and_validate_are_functions(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bevcli.workshop.training.trainer.draw_learning_curves", lambda loss, validation, path: None)
    drives = [folder / "drives/d000", str(folder / "drives/d001")]
    how = {"out": tmp_path / "trained", "steps": 1, "held_out": 1, "device": "cpu"}
    weights = bevcli.train(folder / "mini.toml", data=drives, **how)
    assert weights.name == "weights.safetensors"
    model = bevcli.load_model(folder / "mini.toml", weights=weights)
    scores = bevcli.validate(model, data=drives[1], max_range=20)
    by_name = bevcli.validate(str(folder / "mini.toml"), weights=weights, data=drives[1], max_range=20)
    assert scores.table() == by_name.table()


@pytest.mark.slow
def test_models_are_exported_and_quantised_by_functions(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    model, street = bevcli.load_model("demo"), ROOT / "samples/street"
    file = bevcli.export_onnx(model, out=tmp_path / "demo.onnx", rig=street / "calibration.json", decode=True)
    with pytest.raises(OutputError, match="already exists"):
        bevcli.export_onnx("demo", out=file)
    with pytest.raises(BevcliError, match="`rig` states the number of cameras"):
        bevcli.export_onnx("demo", out=tmp_path / "b.onnx", rig=street / "calibration.json", cameras=3)
    small = bevcli.quantize(file, [street], frames=2)
    assert small == tmp_path / "demo-int8.onnx"
    assert small.stat().st_size < file.stat().st_size
    drive = bevcli.open_sequence(street, frames=slice(0, 1))
    _, prediction = next(bevcli.run(bevcli.load_model(small), drive))
    assert len(prediction.boxes)


@pytest.mark.slow
def test_a_screenshot_and_a_video_are_functions(folder: Path, tmp_path: Path) -> None:
    drive = bevcli.open_sequence(folder / "drives/d000")
    model = bevcli.load_model(folder / "mini.toml", untrained=True)
    bevcli.run_into_folder(model, drive, tmp_path / "run")
    assert bevcli.video(tmp_path / "run", tmp_path / "run.webm") == (3, 2.0)
    assert (tmp_path / "run.webm").stat().st_size > 1000
    try:
        views = bevcli.screenshot(tmp_path / "run", tmp_path / "run.png", frame=1)
    except OutputError as error:
        pytest.skip(str(error))  # no Vulkan driver
    assert "CAM_FRONT" in views


def test_keywords_are_spread_over_options_or_named(folder: Path) -> None:
    written, labels, left = spread({"form": "mcap", "labels": "a.csv", "speed": 3}, WriteOptions, LabelOptions)
    assert (written.form, labels.labels, left) == ("mcap", Path("a.csv"), {"speed": 3})
    model = bevcli.load_model(folder / "mini.toml", untrained=True)
    with pytest.raises(TypeError, match=r"validate\(\) has no option weights"):
        bevcli.validate(model, data=folder, weights="mini.pth")
    with pytest.raises(TypeError, match=r"train\(\) has no option step: did you mean steps\?"):
        bevcli.train("demo", data=folder, step=3)
    refuse({}, "f", WriteOptions)
    with pytest.raises(TypeError, match=r"f\(\) has no option farm: did you mean form\?"):
        refuse({"farm": 1}, "f", WriteOptions)
    for data in ("a", Path("a"), ["a"], (Path("a"),)):
        assert gather(DriveOptions, None, {"data": data}).data == (Path("a"),)
