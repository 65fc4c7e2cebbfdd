"""What Windows, a user without HOME, or the core alone does not have is never needed. Nothing was run on Windows."""

import pwd
import subprocess
import sys

import pytest

from bevcli.published import own_table, read_sources
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
from bevcli.inference.load import peak_memory
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
