"""Strips as Arrow arrays are those that rerun makes of lists."""

from __future__ import annotations

import numpy as np
import pytest
import rerun as rr

from bevcli.recording.components import line_strips


@pytest.mark.parametrize("lengths", [[], [2], [5, 2, 3, 1], [2, 2]])
def test_they_equal_rerun_s_own(lengths):
    random = np.random.default_rng(0)
    flat, solid = ([random.normal(size=(length, size)) for length in lengths] for size in (2, 3))
    of_flat = line_strips(np.concatenate([np.zeros((0, 2)), *flat]), lengths)
    of_solid = line_strips(np.concatenate([np.zeros((0, 3)), *solid]), lengths)
    assert of_flat.equals(rr.components.LineStrip2DBatch(flat).as_arrow_array())
    assert of_solid.equals(rr.components.LineStrip3DBatch(solid).as_arrow_array())
    assert rr.LineStrips2D(of_flat).strips.as_arrow_array().equals(of_flat)
