"""State files give back what was written, bit by bit, and run nothing."""

from dataclasses import dataclass, fields
from hashlib import sha256

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from bevcli.errors import InputError, OutputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.pipeline.runner import BevState
from bevcli.pipeline.state_file import load_state, save_state
from bevcli.pipeline.temporal import BevHistory


def assert_same(one, other):
    assert type(one) is type(other)
    if isinstance(one, torch.Tensor):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other, strict=True)
    elif isinstance(one, (tuple, list)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, dict):
        assert_same(tuple(one.items()), tuple(other.items()))
    elif hasattr(one, "__dataclass_fields__"):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    else:
        assert one == other


def test_a_state_comes_back_exactly(tmp_path):
    pose = Pose(np.array([1 / 3, -2.0, 1e300]), np.array([-1.0, 0, 0, 0]))
    stamp = FrameStamp(7, "straße", 1_533_151_603_547_590_001)
    bev = BevState(BevHistory(torch.randn(1, 12, 4), pose), stamp)
    half = torch.randn(3, 2).to(torch.bfloat16).T
    tree = (bev, {"a": 1, 3: None}, [True, 0.1, float("inf"), -(10**18)], half, torch.tensor(5), np.zeros((0, 3)))
    tree = (*tree, Boxes3D.empty(), np.array(["car", "bus"]), (), {})
    save_state(tmp_path / "state", tree)
    assert_same(load_state(tmp_path / "state"), tree)


def test_a_class_of_another_package_is_refused_and_not_imported(tmp_path):
    for module, name in (("subprocess", "Popen"), ("bevcli.pipeline.runner", "Runner"), ("antigravity", "x")):
        tree = f'["dataclass", "{module}", "{name}", {{}}]'
        save_file(
            {},
            tmp_path / "state",
            {"format": "bevcli-state/1", "tree": tree, "sha256": sha256(tree.encode()).hexdigest()},
        )
        with pytest.raises(InputError, match="not a state of this version"):
            load_state(tmp_path / "state")


@pytest.mark.parametrize("content", [b"", b"nothing", b"\x08" + bytes(7) + b"{}      "])
def test_another_file_is_an_error_of_one_line(tmp_path, content):
    (tmp_path / "state").write_bytes(content)
    with pytest.raises(InputError, match="state"):
        load_state(tmp_path / "state")


def test_a_state_with_one_changed_byte_is_refused(tmp_path):
    save_state(tmp_path / "state", {"frames": 12, "bev": torch.arange(4.0)})
    whole = (tmp_path / "state").read_bytes()
    for place in range(len(whole)):
        broken = bytearray(whole)
        broken[place] ^= 1
        (tmp_path / "state").write_bytes(broken)
        with pytest.raises(InputError) as error:
            load_state(tmp_path / "state")
        assert "\n" not in str(error.value)


def test_a_failed_write_keeps_the_state_before(tmp_path):
    save_state(tmp_path / "state", 1)
    (tmp_path / "state.new").mkdir()
    with pytest.raises(OutputError):
        save_state(tmp_path / "state", 2)
    assert load_state(tmp_path / "state") == 1


@dataclass(frozen=True)
class Foreign:
    x: int = 1


def test_a_class_of_another_package_comes_not_back(tmp_path):
    save_state(tmp_path / "state", Foreign())
    with pytest.raises(InputError):
        load_state(tmp_path / "state")
