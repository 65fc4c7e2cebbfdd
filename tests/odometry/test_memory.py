"""The memory of a long measurement."""

import resource
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.sequences.open import open_sequence
from bevcli.workshop.odometry.measure import measure_steps

STREET = Path(__file__).parents[2] / "samples/street"
STEPS, STEP_NS = 300, 500_000_000
GROWS_MIB = 30.0  # at most, after a third of the steps; features of frames that are kept would be 100 MiB


class ToAndFro(DerivedDrive):
    """The first frames of a drive to and fro, in images of half the size of its first camera."""

    def __init__(self, sequence: Drive, frames: int, count: int) -> None:
        super().__init__(sequence)
        first, turn = sequence.stamps[0], 2 * (frames - 1)
        self._places = [min(place % turn, turn - place % turn) for place in range(count)]
        self.stamps = tuple(
            replace(first, index=place, timestamp_ns=first.timestamp_ns + place * STEP_NS) for place in range(count)
        )
        self.rig = replace(sequence.rig, cameras=(sequence.rig.cameras[0].scaled(0.5),))

    def load(self, index: int) -> Frame:
        frame, stamp, (camera,) = self.drive.load(self._places[index]), self.stamps[index], self.rig.cameras
        image = frame.images[camera.name]
        half = cv2.resize(image.pixels_bgr, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        images = {camera.name: replace(image, timestamp_ns=stamp.timestamp_ns, pixels_bgr=half.astype(np.uint8))}
        poses = {camera.name: frame.world_from_ego}
        return replace(frame, stamp=stamp, rig=self.rig, images=images, world_from_ego_at=poses)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_memory_stays_flat_over_many_steps() -> None:
    drive = ToAndFro(open_sequence(STREET, ground_truth=False), 6, STEPS + 1)
    peaks = [resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 for _ in measure_steps(drive)]
    assert len(peaks) == STEPS
    assert peaks[-1] - peaks[STEPS // 3] < GROWS_MIB
