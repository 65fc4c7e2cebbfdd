"""Garbage collection stops during imports only."""

import gc

import pytest

from bevcli.cli.imports import fast_imports


def test_collection_goes_on_after_imports_and_errors():
    with fast_imports():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ImportError), fast_imports():
        raise ImportError
    assert gc.isenabled()
