"""Resizing and normalising in one pass equals OpenCV's resize of the image as float32."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bevcli.inference.preprocess import pixel_weights, resize_and_normalize

INTERPOLATION = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA}
MEAN, STD = np.array([103.5, 116.3, 123.7], np.float32), np.array([57.4, 57.1, 58.4], np.float32)
lengths = st.integers(1, 90)


def resized(pixels, width, height, method, **options):
    out = np.full((3, height + 2, width + 3), -7, np.float32)
    rows, columns = pixel_weights(len(pixels), height, method), pixel_weights(pixels.shape[1], width, method)
    resize_and_normalize(pixels, rows, columns, MEAN, STD, out, **{"reverse_channels": False} | options)
    assert (out[:, height:] == -7).all()  # the padding is left as it was
    assert (out[:, :, width:] == -7).all()
    return out[:, :height, :width]


def by_opencv(pixels, width, height, method):
    floats = cv2.resize(pixels.astype(np.float32), (width, height), interpolation=INTERPOLATION[method])
    return ((floats - MEAN) / STD).transpose(2, 0, 1)


@settings(max_examples=200, deadline=None)
@given(lengths, lengths, lengths, lengths, st.sampled_from(sorted(INTERPOLATION)), st.integers(0, 2**31))
def test_it_equals_opencv_for_any_size(width, height, new_width, new_height, method, seed):
    if method == "area":  # only for shrinking
        width, new_width = max(width, new_width), min(width, new_width)
        height, new_height = max(height, new_height), min(height, new_height)
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    expected = by_opencv(pixels, new_width, new_height, method)
    # OpenCV rounds positions in the image to float32.
    np.testing.assert_allclose(resized(pixels, new_width, new_height, method), expected, atol=1e-4)


@pytest.mark.parametrize(("size", "method"), [((512, 288), "area"), ((800, 450), "linear"), ((1600, 900), "linear")])
def test_it_equals_opencv_for_the_sizes_of_the_models(size, method):
    pixels = np.random.default_rng(0).integers(0, 256, (900, 1600, 3), dtype=np.uint8)
    np.testing.assert_allclose(resized(pixels, *size, method), by_opencv(pixels, *size, method), atol=5e-6)


def test_channels_are_reversed_and_any_memory_layout_is_read():
    pixels = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)[::2, 4:, ::-1]
    reversed_pixels = np.ascontiguousarray(pixels[..., ::-1])
    expected = by_opencv(reversed_pixels, 13, 7, "area")
    np.testing.assert_allclose(resized(pixels, 13, 7, "area", reverse_channels=True), expected, atol=5e-6)


def test_a_part_of_the_rows_and_columns_is_a_crop():
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    rows, columns = pixel_weights(40, 20, "linear", 5, 15), pixel_weights(60, 30, "linear", 8, 20)
    out = np.zeros((3, 10, 12), np.float32)
    resize_and_normalize(pixels, rows, columns, MEAN, STD, out, reverse_channels=False)
    np.testing.assert_allclose(out, by_opencv(pixels, 30, 20, "linear")[:, 5:15, 8:20], atol=5e-6)
