"""The options of a recording are validated when they are made."""

from pathlib import Path

import pytest

from bevcli.errors import InputError
from bevcli.recording import RecordingOptions


@pytest.mark.parametrize("bev", ["norm", "pca", "none", "channel:0", "channel:17"])
def test_known_kinds_of_bev_images(bev):
    assert RecordingOptions(bev=bev).bev == bev


@pytest.mark.parametrize("wrong", [{"bev": "channel"}, {"bev": "channel:-1"}, {"bev": "heat"}, {"level": "most"}])
def test_unknown_values_are_errors(wrong):
    with pytest.raises(InputError, match="expected"):
        RecordingOptions(**wrong)


def test_a_missing_mesh_file_is_an_error():
    with pytest.raises(InputError, match=r"`vehicle_mesh=none\.glb`"):
        RecordingOptions(vehicle_mesh=Path("none.glb"))
