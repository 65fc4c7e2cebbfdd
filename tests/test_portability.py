"""Linux, macOS and Windows: what exists on some of them only is never needed. Nothing here was run on Windows."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent / "bevcli"
FILES = sorted(ROOT.rglob("*.py"))
# What Windows does not have, of modules, and of the names in them.
MODULES = {"curses", "fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
NAMES = {
    "os": {
        "O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "chown", "fchmod", "fork", "getegid", "geteuid",
        "getgid", "getloadavg", "getpgid", "getuid", "killpg", "lchown", "mkfifo", "nice", "sched_getaffinity",
        "sched_setaffinity", "setpriority", "setsid", "statvfs", "sysconf", "uname", "wait", "waitid",
    },
    "signal": {
        "SIGALRM", "SIGCHLD", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGQUIT", "SIGSTOP", "SIGTSTP", "SIGUSR1", "SIGUSR2",
        "SIG_BLOCK", "SIG_SETMASK", "alarm", "pause", "pthread_sigmask", "setitimer", "sigwait",
    },
}  # fmt: skip
MENTIONED = re.compile(rf"\b({'|'.join(MODULES.union(*NAMES.values()))})\b")
GUARD = re.compile(r"sys\.platform|os\.name|hasattr\(|getattr\(|except ImportError")


def parents(tree: ast.AST) -> dict[ast.AST, ast.AST]:
    """The parent of each node."""
    return {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}


def is_guarded(node: ast.AST, above: dict[ast.AST, ast.AST], text: str) -> bool:
    """True in a function that asks for the system, or catches that a module is missing."""
    while node in above and not isinstance(node, ast.FunctionDef):
        node = above[node]
    return isinstance(node, ast.FunctionDef) and GUARD.search(ast.get_source_segment(text, node) or "") is not None


def needed_from_posix(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8")
    if not MENTIONED.search(text):
        return []
    tree, wrong = ast.parse(text), list[str]()
    above = parents(tree)
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name in MODULES]
        elif isinstance(node, ast.ImportFrom) and node.module in MODULES | NAMES.keys():
            missing = NAMES.get(node.module, set())
            names = [alias.name for alias in node.names if node.module in MODULES or alias.name in missing]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            names = [node.attr] if node.attr in NAMES.get(node.value.id, set()) else []
        wrong += [f"{path.name}:{node.lineno} {name}" for name in names if not is_guarded(node, above, text)]
    return wrong


def test_what_windows_lacks_is_asked_for_first() -> None:
    assert [each for path in FILES for each in needed_from_posix(path)] == []


@pytest.mark.parametrize(
    "line", ["import fcntl", "def f():\n    import resource", "import os\nos.fork()", "from signal import SIGALRM"]
)
def test_what_windows_lacks_is_found(line: str, tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(line, encoding="utf-8")
    assert needed_from_posix(tmp_path / "a.py")


def test_text_files_state_their_encoding() -> None:
    """Windows reads and writes text in its own encoding unless it is stated."""
    wrong = []
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        calls = ast.walk(ast.parse(text)) if re.search(r"_text\(|\bopen\(", text) else ()
        for node in calls:
            if not isinstance(node, ast.Call) or any(keyword.arg in ("encoding", None) for keyword in node.keywords):
                continue
            function = node.func
            named = isinstance(function, ast.Attribute) and function.attr in ("read_text", "write_text")
            opened = isinstance(function, ast.Name) and function.id == "open"
            mode = next((a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)), "r")
            if named or (opened and "b" not in mode):
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert wrong == []


def test_no_process_is_forked() -> None:
    """A forked process of a program with threads hangs, and Windows has none."""
    assert [path.name for path in FILES if re.search(r"""["']fork(server)?["']""", path.read_text("utf-8"))] == []


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
from bevcli.inference.machine import peak_memory
import torch
assert peak_memory(torch.device("cpu")) == 0
"""


@pytest.mark.slow
def test_every_module_is_imported_without_posix() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_POSIX], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
