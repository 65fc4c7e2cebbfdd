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
    assert line_strips(flat, 2).equals(rr.components.LineStrip2DBatch(flat).as_arrow_array())
    assert line_strips(solid, 3).equals(rr.components.LineStrip3DBatch(solid).as_arrow_array())
    assert rr.LineStrips2D(line_strips(flat, 2)).strips.as_arrow_array().equals(line_strips(flat, 2))
