"""Fixtures of all tests: a tiny model, the folder of the reference data, and what the program sets or starts once."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import cache
from importlib import resources
from pathlib import Path

import pytest
import torch
from warm_python import WarmPython

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.inference.machine import keep_freed_memory
from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.decoder import DecoderConfig
from bevcli.model.encoder import EncoderConfig
from bevcli.model.fpn import FPNConfig
from bevcli.model.network import Network
from bevcli.model.resnet import ResNetConfig
from bevcli.viewer import recording_file
from bevcli.workshop.bevformer_v2 import NO_EGO_MOTION, BEVFormerV2, BEVFormerV2Config, BevFusionConfig
from bevcli.workshop.vad.vad import VAD, LineDecoderConfig, MotionConfig, VADConfig

SMALL_TINY = {
    "size = [800, 450]": "size = [160, 90]",
    "rows = 50": "rows = 12",
    "columns = 50": "columns = 10",
    "channels = 256": "channels = 32",
    "blocks = [3, 4, 6, 3]": "blocks = [1, 1, 1, 1]\nwidth = 8",
    "queries = 900": "queries = 30",
}


@pytest.fixture
def small_model_file(tmp_path: Path) -> Path:
    """The TOML file of tiny with changed lines."""
    text = resources.files("bevcli").joinpath("configs/tiny.toml").read_text()
    for old, new in SMALL_TINY.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "small.toml").write_text(text)
    return tmp_path / "small.toml"


@pytest.fixture(scope="session", autouse=True)
def no_weights_of_the_user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Weights that were downloaded on this machine, and its user's own names for weights, change no test."""
    folder = tmp_path_factory.mktemp("user")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BEVCLI_WEIGHTS_DIR", str(folder / "weights"))
        patch.setenv("XDG_CONFIG_HOME", str(folder / "settings"))
        yield


@pytest.fixture(scope="session", autouse=True)
def memory_settings_of_the_program() -> None:
    """The program sets them at its start: otherwise page faults take much of the time of large models."""
    keep_freed_memory()


@pytest.fixture(scope="session", autouse=True)
def warm_python() -> Iterator[WarmPython]:
    """The process that checks a recording makes its imports once a worker. Tests of the process itself undo this."""
    warm = WarmPython()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording_file, "run_python", warm)
        yield warm
    warm.close()


@pytest.fixture(scope="session", autouse=True)
def assets_built_once() -> Iterator[None]:
    """The meshes of rendered drives, which are always the same. They are imported where tests of rendering are."""
    with pytest.MonkeyPatch.context() as patch:
        if catalog := sys.modules.get("bevcli.workshop.synth.catalog"):
            patch.setattr(catalog.Assets, "build", cache(catalog.Assets.build))
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real frames and reference numbers; skips the test where there is none."""
    folder = os.environ.get("BEVCLI_SHARED")
    if not folder:
        pytest.skip("BEVCLI_SHARED is not set: no real frames and reference numbers here")
    return Path(folder)


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A folder with the sample street as a clone has it, but for its frames after the fourth."""
    street = tmp_path / "samples" / "street"
    shutil.copytree(Path(__file__).parents[1] / "samples" / "street", street)
    lines = (street / "frames.csv").read_text().splitlines()
    (street / "frames.csv").write_text("\n".join(lines[:5]))
    return tmp_path


@pytest.fixture
def unchecked_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    """`open_recording` starts no process that reads all of a recording: the test does so itself."""
    monkeypatch.setattr(recording_file, "_check", lambda file, path: None)


@pytest.fixture(scope="session")
def mini_config() -> ModelConfig:
    """A BEVFormer with all its parts, so small that a step takes milliseconds."""
    return ModelConfig(
        name="mini",
        classes=tuple(NUSCENES_CLASSES),
        cameras=tuple(NUSCENES_YAWS_DEG),
        image=ImageConfig(size=(160, 90), mean=(123.0, 116.0, 103.0), std=(58.0, 57.0, 57.0), color_order="rgb"),
        bev_grid=BevGrid(rows=12, columns=10, x_range_m=(-25, 25), y_range_m=(-30, 30)),
        channels=32,
        backbone=ResNetConfig(blocks=(1, 1, 1, 1), width=8),
        encoder=EncoderConfig(layers=2, attention_heads=4, feed_forward_width=64),
        decoder=DecoderConfig(layers=2, attention_heads=4, queries=30, feed_forward_width=64, max_boxes=20),
    )


def stirred(make: Callable[[], Network]) -> Network:
    """A model with random weights, the same in every test; attention weights and residual branches are not zero."""
    torch.manual_seed(0)
    model = make().eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


@pytest.fixture(scope="session")
def mini_model(mini_config) -> BEVFormer:
    return stirred(lambda: BEVFormer(mini_config))


@pytest.fixture(scope="session")
def mini_vad(mini_config) -> VAD:
    """Random weights with which some lines score above the threshold, so that objects attend to them."""
    settings = {field.name: getattr(mini_config, field.name) for field in fields(mini_config)}
    lines = LineDecoderConfig(lines=8, line_points=5, layers=1, attention_heads=4, feed_forward_width=32, max_lines=6)
    motion = MotionConfig(modes=2, steps=3, attention_heads=4, feed_forward_width=32, max_line_distance=0.4)
    model = stirred(lambda: VAD(VADConfig(**settings | {"name": "mini-vad"}, line_decoder=lines, motion=motion)))
    with torch.no_grad():
        model.line_decoder.class_branches[-1][-1].bias.zero_()
    return model


@pytest.fixture(scope="session")
def window_model(mini_config):
    """A function: frames of the window -> a small BEVFormerV2; models of as many frames have the same weights."""
    encoder, decoder = (replace(part, layers=1) for part in (mini_config.encoder, mini_config.decoder))
    changes = {"ego_motion": NO_EGO_MOTION, "neck": FPNConfig(levels=5), "fusion": BevFusionConfig(2, 48)}
    changes |= {"encoder": encoder, "decoder": decoder}

    def make(*frames: int) -> BEVFormerV2:
        settings = {field.name: getattr(mini_config, field.name) for field in fields(mini_config)}
        return stirred(lambda: BEVFormerV2(BEVFormerV2Config(**{**settings, **changes}, frames=frames)))

    return make
