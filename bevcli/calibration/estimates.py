"""What a drive says about each camera, and about the whole rig."""

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

from bevcli.geometry.transforms import Array

Triple = tuple[float, float, float]


class Verdict(Enum):
    """What is done with a camera's calibration."""

    FINE = "fine"
    CORRECTED = "corrected"
    NOT_MEASURABLE = "not measurable"


@dataclass(frozen=True)
class CameraEstimate:
    """What a drive says about one camera.

    Attributes:
        camera: its name.
        verdict: what is done with its calibration.
        reason: why it is not measurable; "" else.
        rotation_deg: yaw, pitch and roll of the stated rotation minus the measured one, degrees, as in `Mounting`.
        rotation_deviation_deg: standard deviations.
        position_m: x, y, z of the stated position minus the measured one, metres, ego frame.
        position_deviation_m: standard deviations; that of the stated position where nothing is measured.
        delay_ms: how much later than stated its images were taken.
        delay_deviation_ms: standard deviation.
        matches: matched points.
        road_points: points of the road.
        before_px: median residual of the matched points with the stated calibration, pixels of the original image.
        after_px: the same with the measured one.
        change: (7,) rotation in the camera frame, radians; position in the ego frame, metres; delay, seconds.
        covariance: (7, 7) of it.
    """

    camera: str
    verdict: Verdict
    reason: str
    rotation_deg: Triple
    rotation_deviation_deg: Triple
    position_m: Triple
    position_deviation_m: Triple
    delay_ms: float
    delay_deviation_ms: float
    matches: int
    road_points: int
    before_px: float
    after_px: float
    change: Array
    covariance: Array

    def to_dict(self) -> dict[str, Any]:
        """For the report."""
        entry = asdict(self) | {"verdict": self.verdict.value}
        return entry | {"change": self.change.tolist(), "covariance": self.covariance.tolist()}


@dataclass(frozen=True)
class RigEstimate:
    """What a drive says about the whole rig.

    Attributes:
        scale: of the ego-motion minus 1: 0.01 if the vehicle drove 1 % farther than stated.
        scale_deviation: standard deviation.
        height_m: mean height of the cameras above the road, stated minus measured, metres.
        height_deviation_m: standard deviation.
        tilt_deg: pitch and roll of the ego frame over the road, degrees: positive if its front, its left points down.
        tilt_deviation_deg: standard deviations.
    """

    scale: float
    scale_deviation: float
    height_m: float
    height_deviation_m: float
    tilt_deg: tuple[float, float]
    tilt_deviation_deg: tuple[float, float]
