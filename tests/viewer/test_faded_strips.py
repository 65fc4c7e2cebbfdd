"""Lines on the ground in videos: opaque ones hide what is below, faint ones let it through."""

import numpy as np

from bevcli.workshop.video import draw_faded_strips

GREEN = 0x00FF0000  # RGB, without opacity


class Recorded:
    """One horizontal line on a row, with a colour."""

    def __init__(self, opacity: int) -> None:
        self.color = GREEN | opacity

    def strips(self, entity: str, component: str) -> list[np.ndarray]:
        return [np.array([[2.0, 5.0], [17.0, 5.0]])]

    def integers(self, entity: str, component: str) -> list[int]:
        return [self.color]


def green_of(opacity: int) -> int:
    canvas = np.full((11, 20, 3), 40, dtype=np.uint8)
    draw_faded_strips(canvas, Recorded(opacity), "lines", lambda points: points)
    return int(canvas[5, 10, 1])


def test_lines_in_videos_have_their_opacity():
    opaque = green_of(255)
    assert opaque > 200  # its edge is smoothed
    assert green_of(0) == 40  # invisible
    shares = [(green_of(opacity) - 40) / (opaque - 40) for opacity in (51, 128)]
    np.testing.assert_allclose(shares, [0.2, 0.5], atol=0.11)  # drawn in tenths
