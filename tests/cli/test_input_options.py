"""The options that select inputs, models and devices."""

import json

import pytest
import torch
from typer.testing import CliRunner

from bevcli.cli.main import app
from bevcli.config import known_models
from bevcli.errors import BevcliError
from bevcli.inference.load import Model, choose_device
from bevcli.inference.options import complete_model
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions, parse_frames, parse_rate


@pytest.mark.parametrize(
    ("text", "frames"), [("1:3", [1, 2]), (":2", [0, 1]), ("3:99", [3, 4]), ("4:", [4]), (":", [0, 1, 2, 3, 4])]
)
def test_frames_range_excludes_its_end(text, frames):
    assert [0, 1, 2, 3, 4][parse_frames(text)] == frames


@pytest.mark.parametrize("text", ["3", "a:b", "-1:2", "1:2:3", "", "٠:٢", "0:" + "9" * 5000])
def test_invalid_frames_range_is_a_usage_error(text):
    with pytest.raises(ValueError, match="expected A:B"):
        parse_frames(text)


def test_rate_is_a_number_or_all():
    assert parse_rate("2.5") == 2.5
    assert parse_rate("all") == "all"


@pytest.mark.parametrize("text", ["fast", "-2", "0", "inf", "nan"])
def test_invalid_rate_is_a_usage_error(text):
    with pytest.raises(ValueError, match="frames per second"):
        parse_rate(text)


def test_static_takes_precedence_over_no_temporal(mini_model):
    model = Model(mini_model)
    static = InputOptions(ego_motion="static")
    assert static.for_model(model.config, temporal=False).ego_motion == "static"
    assert InputOptions().for_model(model.config, temporal=False).ego_motion == "optional"
    assert InputOptions().for_model(model.config).ego_motion == "required"


def test_model_names_are_completed():
    assert sorted(complete_model("")) == sorted({*known_models(), "tiny-fp16"})


def test_a_shell_is_given_the_names_that_start_with_the_text():
    words = {"_BEVCLI_COMPLETE": "complete_bash", "COMP_WORDS": "bevcli run x --model ti", "COMP_CWORD": "4"}
    assert CliRunner().invoke(app, [], prog_name="bevcli", env=words).output.split() == ["tiny", "tiny-fp16"]


@pytest.mark.parametrize("name", ["cuda:", "gpu", "cuda:x"])
def test_an_unknown_device_is_an_error(name):
    with pytest.raises(BevcliError, match=rf"`device={name}` \(`--device`\): unknown device"):
        choose_device(name)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_numbered_gpu_that_is_not_there_is_an_error():
    with pytest.raises(BevcliError, match=r"`device=cuda:1` \(`--device`\): PyTorch sees no CUDA GPU here"):
        choose_device("cuda:1")


def test_the_sample_drive_is_copied_once(tmp_path):
    for words in ("copied", "exists already"):
        result = CliRunner().invoke(app, ["samples", "--out", str(tmp_path / "samples")])
        assert result.exit_code == 0
        assert words in result.output
    assert len(open_sequence(tmp_path / "samples/street").stamps) == 20
    assert json.loads((tmp_path / "samples/first_steps.ipynb").read_text())["cells"]
