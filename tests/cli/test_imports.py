"""Garbage collection stops during imports only."""

import gc

import pytest

from bevcli.parsing.documents import without_garbage_collection


def test_collection_goes_on_after_imports_and_errors():
    with without_garbage_collection():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ImportError), without_garbage_collection():
        raise ImportError
    assert gc.isenabled()
