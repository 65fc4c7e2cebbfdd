"""BEV features as images: colours are fixed after two frames, forward is up."""

import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.recording.log_ground import BevImages


def features(seed: int, rows: int = 6, columns: int = 5, channels: int = 12) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, columns, channels)).astype(np.float32)


@pytest.mark.parametrize("kind", ["norm", "pca", "channel:3"])
def test_colours_are_fitted_on_two_frames_and_then_kept(kind):
    images = BevImages(kind)
    assert images.push(0, features(0)) == []  # the first frame's image is ready with the second
    ready = images.push(1, features(1))
    assert [stamp for stamp, _ in ready] == [0, 1]
    images.push(2, 100 * features(2))  # would change any range that is not fixed
    ((_, again),) = images.push(3, features(0))
    np.testing.assert_array_equal(again, ready[0][1])


def test_the_image_of_a_single_frame_is_ready_at_the_end():
    images = BevImages("pca")
    assert images.push("only", features(0)) == []
    ((stamp, image),) = images.finish()
    assert stamp == "only"
    assert image.shape == (6, 5, 3)
    assert images.finish() == []


def test_the_row_with_the_largest_y_is_on_top():
    cells = np.zeros((4, 3, 2), dtype=np.float32)
    cells[3, 0] = 9  # row 3: the largest y; column 0: the smallest x
    images = BevImages("norm")
    images.push(0, cells)
    ((_, image),) = images.finish()
    brightest = np.unravel_index(image.sum(-1).argmax(), (4, 3))
    assert brightest == (0, 0)


def test_principal_components_are_those_of_the_singular_values():
    images = BevImages("pca")
    cells = np.zeros((20, 20, 3), dtype=np.float32)
    cells[..., 1] = np.linspace(-9, 9, 20)[:, None]  # the largest spread
    cells[..., 0] = np.linspace(-3, 3, 20)[None]
    images.push(0, cells)
    ((_, image),) = images.finish()
    red, green = image[..., 0].astype(int), image[..., 1].astype(int)
    assert (np.diff(red[:, 7]) <= 0).all()  # red is the largest component, along y; the largest y is on top
    assert red[0, 7] - red[-1, 7] > 200
    assert (np.diff(green[7]) >= 0).all()


def test_a_missing_channel_is_an_input_error():
    images = BevImages("channel:12")
    images.push(0, features(0))
    with pytest.raises(InputError, match="channels 0 to 11"):
        images.push(1, features(1))
