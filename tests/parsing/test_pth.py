"""PyTorch files: tensors and plain values are read, everything else is left out, and nothing in the file runs."""

import collections
import datetime
import io
import os
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from bevcli.checkpoints import read_checkpoint
from bevcli.errors import WeightsError
from bevcli.parsing import pth
from bevcli.parsing.pth import read_pth

OLD = {"_use_new_zipfile_serialization": False}
FORMATS = pytest.mark.parametrize("options", [{}, OLD], ids=["zip", "old format"])


class ConfigDict(dict):
    """A class that bevcli does not know, such as mmcv's."""


class Runs:
    """An object whose unpickling calls a function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def tensors_of_many_kinds() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    base = torch.randn(6, 8)
    return {
        "plain": torch.randn(3, 4, 5),
        "half": torch.randn(7).half(),
        "bfloat": torch.randn(7).bfloat16(),
        "double": torch.randn(2, 2).double(),
        "transposed": base.t(),
        "part": base[2:4, 1::2],
        "repeated": torch.randn(1).expand(4, 5),
        "scalar": torch.tensor(2.5),
        "empty": torch.zeros(0, 3),
        "parameter": torch.nn.Parameter(torch.randn(3)),
        "norm.num_batches_tracked": torch.tensor(7),
    }


@FORMATS
def test_the_tensors_are_those_of_torch_load(tmp_path: Path, options: dict) -> None:
    path = tmp_path / "all.pth"
    module = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4))
    for state in (tensors_of_many_kinds(), module.state_dict()):
        torch.save({"state_dict": state, "meta": {"epoch": 3}}, path, **options)
        expected, found = torch.load(path, weights_only=True)["state_dict"], read_checkpoint(path)
        assert list(found.state) == list(expected)
        for key in expected:
            assert found.state[key].dtype == expected[key].dtype, key
            assert torch.equal(found.state[key], expected[key]), key
        assert found.facts == {"epoch": "3"}


@FORMATS
def test_objects_beside_the_tensors_are_left_out_and_named(tmp_path: Path, options: dict) -> None:
    path = tmp_path / "epoch_24.pth"
    contents = {
        "meta": {
            "epoch": 24,
            "time": "Tue Aug 16",
            "score": np.float64(0.4),
            "palette": np.zeros((3, 3)),
            "date": datetime.datetime(2022, 8, 16),
            "folder": Path("/data"),
            "config": ConfigDict(lr=1e-3),
            "counts": collections.defaultdict(list, a=[1]),
            "last": collections.deque([1, 2]),
            "names": {"car", "bus"},
            "metric": np.mean,
        },
        "state_dict": collections.OrderedDict(weight=torch.arange(3.0)),
        "optimizer": {"state": {0: {"step": torch.tensor(4), "best": np.float32(1)}}, "hook": ConfigDict()},
    }
    torch.save(contents, path, **options)
    with pytest.raises(pickle.UnpicklingError):
        torch.load(path, weights_only=True)
    found = read_checkpoint(path)
    assert torch.equal(found.state["weight"], torch.arange(3.0))
    assert found.facts == {"epoch": "24", "time": "Tue Aug 16"}
    named = " ".join(found.not_read)
    for name in ("datetime.datetime", "ConfigDict", "pathlib", "numpy"):
        assert name in named


@FORMATS
@pytest.mark.parametrize("where", ["meta", "weight", "top"])
@pytest.mark.parametrize("function", [os.system, os.popen, eval, exec], ids=lambda function: function.__name__)
def test_a_file_that_calls_a_program_is_refused_wherever_it_does(
    tmp_path: Path, options: dict, where: str, function: object
) -> None:
    path, proof = tmp_path / "evil.pth", tmp_path / "proof"
    text = f"open({str(proof)!r}, 'w')" if function in (eval, exec) else f"touch {proof}"
    good = {"weight": torch.zeros(2)}
    evil = Runs(function, text)
    contents = {
        "meta": {"state_dict": good, "meta": {"time": evil}},
        "weight": {"state_dict": {**good, "weight": evil}},
        "top": evil,
    }[where]
    torch.save(contents, path, **options)
    with pytest.raises(WeightsError, match="not safe to read"):
        read_checkpoint(path)
    assert not proof.exists()


@FORMATS
def test_tensors_behind_code_are_refused_and_code_does_not_run(
    tmp_path: Path, options: dict, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "hidden.pth"
    for contents in ({"state_dict": {"weight": Runs(print, "ran")}}, {"state_dict": Runs(print, "ran")}):
        torch.save(contents, path, **options)
        with pytest.raises(WeightsError, match="hidden behind code"):
            read_checkpoint(path)
    torch.save({"state_dict": {"weight": torch.zeros(1)}, "meta": Runs(print, "ran")}, path, **options)
    assert [name.split(".")[1] for name in read_checkpoint(path).not_read] == ["print"]
    assert "ran" not in capsys.readouterr().out


class Describes:
    """A tensor as the file describes it: a call of one of PyTorch's functions with any arguments."""

    def __init__(self, function, storage, *arguments):
        self.function, self.storage, self.arguments = function, storage, arguments

    def __reduce__(self):
        return self.function, (self.storage, *self.arguments)


@FORMATS
@pytest.mark.parametrize(
    ("offset", "shape", "strides"),
    [
        (0, (11,), (1,)),
        (9, (2,), (1,)),
        (2**62, (1,), (1,)),
        (-1, (2,), (1,)),
        (0, (-2,), (1,)),
        (0, (2,), (-1,)),
        (0, (2,), (2**61,)),
        (0, (2**40, 2), (0, 0)),
        (0, (2**61, 2**61), (0, 0)),
        (0, (2, 2), (1,)),
        (0, (2.0,), (1,)),
        (0, (True,), (1,)),
        (0, "ab", (1,)),
        (None, (2,), (1,)),
    ],
)
def test_a_tensor_beyond_its_numbers_is_refused(
    tmp_path: Path, options: dict, offset: object, shape: object, strides: object
) -> None:
    path = tmp_path / "odd.pth"
    storage = torch.zeros(10).storage()
    odd = Describes(torch._utils._rebuild_tensor_v2, storage, offset, shape, strides, False, {})
    torch.save({"weight": odd}, path, **options)
    with pytest.raises(WeightsError, match=r"safe to read|tensor weight"):
        read_checkpoint(path)


@FORMATS
def test_a_storage_beyond_the_file_is_refused(tmp_path: Path, options: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch would read what lies behind the file's bytes in memory."""
    path, numbers = tmp_path / "long.pth", 10**9
    storage = torch.zeros(10).storage()
    monkeypatch.setattr(torch.storage.TypedStorage, "_size", lambda self: numbers)
    odd = Describes(torch._utils._rebuild_tensor_v2, storage, 0, (numbers,), (1,), False, {})
    torch.save({"weight": odd}, path, **options)
    with pytest.raises(WeightsError, match="safe to read"):
        read_checkpoint(path)


def test_sparse_and_meta_tensors_and_integer_keys_are_errors(tmp_path: Path) -> None:
    path = tmp_path / "odd.pth"
    for state in (
        {"weight": torch.eye(3).to_sparse()},
        {"weight": torch.empty(3, device="meta")},
        {"weight": torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.qint8)},
        {0: torch.zeros(3)},
        {"a": torch.zeros(3), ("b",): torch.zeros(3)},
    ):
        torch.save({"state_dict": state, "meta": {}}, path)
        if len(state) == 2:  # a key that is no text is left out
            assert list(read_checkpoint(path).state) == ["a"]
            continue
        with pytest.raises(WeightsError):
            read_checkpoint(path)


@pytest.mark.parametrize("dtype", [torch.int8, torch.int64, torch.complex64, torch.bool])
def test_weights_of_another_number_type_name_the_tensor(tmp_path: Path, dtype: torch.dtype) -> None:
    path = tmp_path / "typed.pth"
    torch.save({"fine": torch.zeros(2), "neck.weight": torch.zeros(2, dtype=dtype)}, path)
    with pytest.raises(WeightsError, match=r"tensor neck\.weight: numbers of type"):
        read_checkpoint(path)


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_one_bad_number_names_the_tensor_and_its_place(tmp_path: Path, suffix: str, value: float) -> None:
    import safetensors.torch

    path, tensor = tmp_path / f"bad{suffix}", torch.zeros(4, 5)
    tensor[2, 3] = value
    state = {"fine": torch.zeros(2), "decoder.weight": tensor}
    torch.save(state, path) if suffix == ".pth" else safetensors.torch.save_file(state, path)
    with pytest.raises(WeightsError, match=r"tensor decoder\.weight: 1 of 20 numbers .* index \(2, 3\)"):
        read_checkpoint(path)


def _zip_of(path: Path, data: bytes, compression: int = zipfile.ZIP_STORED, **entries: bytes) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("archive/data.pkl", data)
        for name, content in entries.items():
            archive.writestr(f"archive/data/{name}", content)


def test_a_compressed_archive_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.pth"
    _zip_of(path, b"\x80\x02]q\x00." + b"\x00" * 50_000_000, zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 100_000
    with pytest.raises(WeightsError, match="compressed"):
        read_pth(path)


@pytest.mark.parametrize(
    "data",
    [
        b"\x80\x02" + b"\x8e" + struct.pack("<Q", 2**60),  # a string of an exabyte
        b"\x80\x02" + b"\x96" + struct.pack("<Q", 2**36),  # a bytearray of 64 GiB
        b"\x80\x02]r" + struct.pack("<I", 2**32 - 1) + b"j" + struct.pack("<I", 5) + b".",
        b"\x80\x02" + b"]" * 30_000,
        b"\x80\x02" + b"(" * 1000 + b"t" * 1001 + b".",
        b"\x80\x02\x82\x01.",  # the extension registry
        b"\x80\x02(cos\nsystem\nU\x04trueo.",  # an instance, in protocol 1
        b"\x80\x02(U\x04trueios\nsystem\n.",
        b"\x80\x02Q.",
        b"\x80\x02K\x01)R.",  # a call of the number 1
        b"\x80\x02K\x01K\x01b",
    ],
    ids=range(11),
)
def test_pickles_that_python_would_choke_on_are_refused(
    tmp_path: Path, data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pth, "MOST_OPCODES", 20_000)  # two million take seconds
    path = tmp_path / "odd.pth"
    _zip_of(path, data)
    with pytest.raises(WeightsError, match="safe to read"):
        read_pth(path)


def test_attributes_in_the_file_never_reach_an_object_of_ours(tmp_path: Path) -> None:
    class Sets:
        def __reduce__(self):
            return collections.OrderedDict, (), {"update": "replaced", "__class__": "replaced"}

    path = tmp_path / "set.pth"
    torch.save({"state_dict": Sets()}, path)
    contents = read_pth(path).contents
    assert callable(contents["state_dict"].update)


@FORMATS
def test_a_file_cut_anywhere_is_an_error(tmp_path: Path, options: dict) -> None:
    path, buffer = tmp_path / "short.pth", io.BytesIO()
    torch.save({"weight": torch.arange(10.0)}, buffer, **options)
    for size in range(0, len(buffer.getvalue()), 3 if options else 7):
        path.write_bytes(buffer.getvalue()[:size])
        with pytest.raises(WeightsError):
            read_checkpoint(path)
