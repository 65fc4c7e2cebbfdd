"""What Windows, a user without HOME, a read-only installation, or the core alone does not have is never needed."""

import importlib
import os
import pwd
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import full_disk

import bevcli
from bevcli.published import own_table, read_sources
from bevcli.workshop.synth.commands import is_compiled
from bevcli.writing import user_cache

MODULES = {"curses", "fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
WITHOUT_POSIX = f"""
import builtins
original = builtins.__import__
def imported(name, globals=None, locals=None, fromlist=(), level=0):
    if name in {MODULES!r} and (globals or {{}}).get("__name__", "").startswith("bevcli"):
        raise ModuleNotFoundError(name)
    return original(name, globals, locals, fromlist, level)
builtins.__import__ = imported
import pkgutil, importlib, bevcli
for module in pkgutil.walk_packages(bevcli.__path__, "bevcli."):
    if not module.name.endswith("__main__") and "triton" not in module.name:
        importlib.import_module(module.name)
from bevcli.workshop.benchmark.measure import peak_memory
import torch
assert peak_memory(torch.device("cpu")) == 0
"""


@pytest.mark.slow
def test_every_module_is_imported_without_posix() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_POSIX], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def test_a_user_without_a_home_has_folders_that_are_not_there(monkeypatch):
    def unknown(user):
        raise KeyError(user)

    known = read_sources()
    for variable in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    assert not user_cache().exists()
    assert not own_table().exists()
    assert read_sources().keys() <= known.keys()


CODE = "import bevcli.model.kernels.loops, bevcli.workshop.synth.renderer; print('ok')"


@pytest.fixture
def read_only(tmp_path: Path):
    """A copy of the package whose cache folders cannot be made: files stand in their places (root ignores modes)."""
    root = tmp_path / "installed"
    shutil.copytree(
        Path(bevcli.__file__).parent, root / "bevcli", ignore=shutil.ignore_patterns("__pycache__", "*.nb?")
    )
    for folder in [root / "bevcli", *(p for p in (root / "bevcli").rglob("*") if p.is_dir())]:
        (folder / "__pycache__").write_text("")
    return root


def start(root: Path, temporary: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA", "XDG"))}
    environment |= {"PYTHONPATH": str(root), "HOME": "/dev/null/home", "TMPDIR": str(temporary)}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    command = [sys.executable, "-c", CODE]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=root, check=False, timeout=120)


@pytest.mark.slow
def test_without_a_writable_place_the_cache_is_a_private_folder(read_only, tmp_path):
    (tmp_path / "temporary").mkdir()
    done = start(read_only, tmp_path / "temporary")
    assert (done.returncode, done.stdout) == (0, "ok\n"), done.stderr
    assert done.stderr.count("note:") == 1
    folder = next((tmp_path / "temporary").glob("bevcli-numba-*"))
    assert str(folder) in done.stderr
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.slow
def test_a_temporary_folder_that_others_can_write_is_not_used(read_only, tmp_path):
    shared = tmp_path / "temporary" / f"bevcli-numba-{os.getuid()}"
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    done = start(read_only, tmp_path / "temporary")
    assert (done.returncode, done.stdout) == (0, "ok\n"), done.stderr
    assert "not cached" in done.stderr
    assert not any(shared.iterdir())


def imported_double(tmp_path, monkeypatch):
    (tmp_path / "doubling.py").write_text(
        "from bevcli.jit import njit\n\n@njit()\ndef double(number):\n    return 2 * number\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "doubling", raising=False)
    return importlib.import_module("doubling").double


def test_a_function_is_compiled_once_its_cache_is_written(tmp_path, monkeypatch):
    double = imported_double(tmp_path, monkeypatch)
    assert not is_compiled(double)
    assert double(3) == 6
    assert is_compiled(double)
    os.utime(tmp_path / "doubling.py", (2e9, 2e9))  # a later version of the file
    assert not is_compiled(double)


@pytest.mark.parametrize("contents", [b"", b"\x80\x04garbage", b"cut"])
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_a_damaged_cache_is_written_anew(tmp_path, monkeypatch, suffix, contents):
    assert imported_double(tmp_path, monkeypatch)(3) == 6
    [file] = (tmp_path / "__pycache__").glob(f"*{suffix}")
    whole = file.read_bytes()
    file.write_bytes(whole[:-9] if contents == b"cut" else contents)
    double = imported_double(tmp_path, monkeypatch)
    assert double(3) == 6
    assert file.stat().st_size == len(whole)
    assert is_compiled(double)


def test_a_full_disk_costs_the_cache_only(tmp_path, monkeypatch):
    double = imported_double(tmp_path, monkeypatch)
    with full_disk(100):
        assert double(3) == 6
    assert not list((tmp_path / "__pycache__").glob("*.nb?*"))
