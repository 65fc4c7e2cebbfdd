"""Runs a library on somebody else's file in a process of its own, which may take, hang or crash as it likes."""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence

# RLIMIT_DATA, and not the address space: allocators reserve more than they use.
LIMIT_MEMORY = """
def limit_memory():
    try:
        import resource
        resource.setrlimit(resource.RLIMIT_DATA, ({memory}, {memory}))
    except (ImportError, ValueError, OSError):
        pass
"""


def run_python(
    code: str, arguments: Sequence[object], memory: int, seconds: float, environment: Mapping[str, str] = os.environ
) -> subprocess.CompletedProcess[bytes]:
    """Run Python code with the packages that this process finds, not with those of the folder.

    memory: bytes that the process may use from where the code calls `limit_memory()`, after its imports.
    Raises subprocess.TimeoutExpired.
    """
    paths = {"PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-P", "-c", LIMIT_MEMORY.format(memory=memory) + code, *map(str, arguments)]
    return run_program(command, seconds, {**environment, **paths})


def run_program(
    command: Sequence[str], seconds: float, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[bytes]:
    """Run a program that reads nothing. Raises subprocess.TimeoutExpired; any exception ends the program."""
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, env=environment, check=False, timeout=seconds
    )
