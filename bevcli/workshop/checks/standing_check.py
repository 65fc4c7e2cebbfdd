"""Images that move although the vehicle is said to stand (`ego_motion="static"`), by a few pairs of small images.

Whatever else moves, the background of a standing camera stays: most corners look the same in the next frame, at the
same place.
"""

from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.frame import Frame

Gray: TypeAlias = NDArray[np.uint8]
NEEDED = 2  # pairs of frames in which the images move: a bus that passes a single camera hides its background once
WIDTH = 320  # of the small images
CORNERS, FEWEST_CORNERS = 60, 15
PATCH, SEARCH = 5, 1  # half sides of a corner's patch, and of what a camera may shake, pixels
SAME = 0.9  # correlation of a patch that stayed
CONTRAST = 5.0  # least standard deviation of a patch, in those of the noise: a lower one hides that it stayed
NOISE_MASK = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
NOISE_GAIN = 6 * 0.6745  # of the median of what the mask shows
MOVING = 0.3  # share of the corners that stay, below which the images move


class StandingCheck:
    """Compares the images of the frames that it is called with, in order.

    It compares frames 0 and 1, 1 and 2, 3 and 4, 7 and 8 and so on, in the two cameras that look most differently.
    A pair takes about 6 ms.
    """

    note = (
        'the images move as if the vehicle drove, but `ego_motion="static"` (`--static`) says that it stands, so the '
        "history is wrong and boxes are missed: pass `odometry=True` (`--odometry`) in its place, which measures the "
        "motion, or `temporal=False` (`--no-temporal`)"
    )

    def __init__(self) -> None:
        self._number = -1
        self._compared = 1  # the next frame that is compared with the one before
        self._moved = 0  # pairs in which the images moved, without a pair between where they did not
        self._before: dict[str, Gray] = {}

    def images_move(self, frame: Frame) -> bool:
        """True once: at the frame that shows that the vehicle drives."""
        self._number += 1
        if self._moved >= NEEDED or self._number < self._compared - 1:
            return False
        before, self._before = self._before, _small_images(frame)
        if self._number < self._compared:
            return False
        shares = [_staying(before[name], image) for name, image in self._before.items() if name in before]
        moves = max((share for share in shares if share is not None), default=1.0) < MOVING
        self._moved = self._moved + 1 if moves else 0
        self._compared = self._number + 2 if moves else 2 * self._number
        return self._moved >= NEEDED


def _small_images(frame: Frame) -> dict[str, Gray]:
    """The images of the first camera, and of the one that looks most differently."""
    yaws = {camera.name: camera.yaw for camera in frame.rig.cameras if camera.name in frame.images}
    if not yaws:
        return {}
    first = next(iter(yaws))
    names = {first, min(yaws, key=lambda name: np.cos(yaws[name] - yaws[first]))}
    return {name: _small(frame.images[name].pixels_bgr) for name in names}


def _small(pixels_bgr: NDArray[np.uint8]) -> Gray:
    """The green of an image, which is its brightness nearly, and needs half the time."""
    step = max(1, pixels_bgr.shape[1] // (2 * WIDTH))
    green = np.ascontiguousarray(pixels_bgr[::step, ::step, 1])
    size = WIDTH, max(1, round(green.shape[0] * WIDTH / green.shape[1]))
    return cv2.resize(green, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def _staying(before: Gray, now: Gray) -> float | None:
    """The share of the corners of an image that look the same in the next one; None where too few rise above noise."""
    margin = PATCH + SEARCH
    inside = np.zeros(before.shape, dtype=np.uint8)
    inside[margin:-margin, margin:-margin] = 1
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 2 * PATCH, mask=inside)
    least = CONTRAST * max(1.0, _noise(before))
    looked, stay = 0, 0
    for x, y in () if corners is None or now.shape != before.shape else corners[:, 0].astype(int):
        patch = before[y - PATCH : y + PATCH + 1, x - PATCH : x + PATCH + 1]
        if cv2.meanStdDev(patch)[1].item() < least:
            continue
        around = now[y - margin : y + margin + 1, x - margin : x + margin + 1]
        looked += 1
        stay += bool(cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED).max() >= SAME)
    return stay / looked if looked >= FEWEST_CORNERS else None


def _noise(image: Gray) -> float:
    """Standard deviation of the noise, by what a mask shows that plane surfaces and straight edges do not."""
    seen = cv2.filter2D(image, cv2.CV_16S, NOISE_MASK)[::3, ::3]
    return float(np.median(np.abs(seen))) / NOISE_GAIN
