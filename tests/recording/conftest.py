"""Reads mesh files in this process."""

import io
import subprocess
import sys
from types import SimpleNamespace

import pytest

from bevcli.workshop import meshes


@pytest.fixture
def in_this_process(monkeypatch):
    """Meshes are read without a process of their own, whose imports take a second."""

    def read(code, arguments, memory, seconds):
        output = io.BytesIO()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", SimpleNamespace(buffer=output))
            error = meshes.write_parts(*arguments)
        return subprocess.CompletedProcess(arguments, int(bool(error)), output.getvalue(), (error or "").encode())

    monkeypatch.setattr(meshes, "run_python", read)
