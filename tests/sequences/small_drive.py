"""The images of the small drive in conftest.py."""

import numpy as np

CAMERAS = ("CAM_FRONT", "CAM_BACK")
SIZE = (64, 36)


def image_of(camera: str, number: int) -> np.ndarray:
    """An image that is different for every camera and number, with smooth and sharp parts."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    seed = CAMERAS.index(camera) * 40 + number * 7
    return np.stack([u * 3 + seed, v * 5 + seed, (u // 4 + v // 4 + number) % 2 * 200], axis=-1).astype(np.uint8)
