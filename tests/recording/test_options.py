"""Options of a recording are checked where they are made."""

import pytest

from bevcli.errors import InputError
from bevcli.recording.options import RecordingOptions


@pytest.mark.parametrize("bev", ["norm", "pca", "none", "channel:0", "channel:17"])
def test_known_images(bev):
    assert RecordingOptions(bev=bev).channel == (int(bev[8:]) if ":" in bev else None)


@pytest.mark.parametrize("wrong", [{"bev": "channel"}, {"bev": "channel:-1"}, {"bev": "heat"}, {"level": "most"}])
def test_unknown_ones_are_refused(wrong):
    with pytest.raises(InputError, match="expected"):
        RecordingOptions(**wrong)
