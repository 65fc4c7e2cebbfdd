"""The options that select inputs, models and devices, and what `run` tells before it starts."""

import pytest
import torch
import typer
from typer.testing import CliRunner

from bevcli.cli.input_options import complete_model, ego_motion_use, parse_frames, parse_rate
from bevcli.cli.main import app
from bevcli.config import known_models
from bevcli.errors import BevcliError
from bevcli.pipeline.model_loading import choose_device
from bevcli.sequences.open import open_sequence


@pytest.mark.parametrize(
    ("text", "frames"),
    [(None, [0, 1, 2, 3, 4]), ("1:3", [1, 2]), (":2", [0, 1]), ("3:99", [3, 4]), ("4:", [4]), (":", [0, 1, 2, 3, 4])],
)
def test_frames_range_excludes_its_end(text, frames):
    chosen = parse_frames(text)
    assert [0, 1, 2, 3, 4][slice(None) if chosen is None else chosen] == frames


@pytest.mark.parametrize("text", ["3", "a:b", "-1:2", "1:2:3", ""])
def test_invalid_frames_range_is_a_usage_error(text):
    with pytest.raises(typer.BadParameter, match="expected A:B"):
        parse_frames(text)


def test_rate_is_a_number_or_all():
    assert parse_rate("2.5", default_hz=2.0) == 2.5
    assert parse_rate("all", default_hz=2.0) is None
    assert parse_rate(None, default_hz=2.0) == 2.0


@pytest.mark.parametrize("text", ["fast", "-2", "0", "inf", "nan"])
def test_invalid_rate_is_a_usage_error(text):
    with pytest.raises(typer.BadParameter, match="frames per second"):
        parse_rate(text, default_hz=2.0)


def test_static_takes_precedence_over_no_temporal():
    assert ego_motion_use(static=True, temporal=False) == "static"
    assert ego_motion_use(static=False, temporal=False) == "optional"
    assert ego_motion_use(static=False, temporal=True) == "required"


def test_model_names_are_completed():
    assert complete_model("") == list(known_models())
    assert complete_model("ti") == ["tiny"]


@pytest.mark.parametrize("name", ["cuda:", "gpu", "cuda:x"])
def test_an_unknown_device_is_an_error(name):
    with pytest.raises(BevcliError, match=f"--device {name}: unknown device"):
        choose_device(name)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_numbered_gpu_that_is_not_there_is_an_error():
    with pytest.raises(BevcliError, match="--device cuda:1: PyTorch sees no CUDA GPU here"):
        choose_device("cuda:1")


def test_the_sample_drive_is_copied_once(tmp_path):
    for words in ("copied", "exists already"):
        result = CliRunner().invoke(app, ["samples", "--out", str(tmp_path / "samples")])
        assert result.exit_code == 0
        assert words in result.output
    assert len(open_sequence(tmp_path / "samples/street").stamps) == 20
