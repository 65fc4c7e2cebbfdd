"""The table of a calibration from motion for a terminal."""

from collections.abc import Sequence as Items

import numpy as np

from bevcli.calibration.estimates import CameraEstimate, RigEstimate, Verdict

HEADER = (
    "camera", "yaw off by", "pitch", "roll", "x off by", "y", "z", "matches", "residual px", "verdict",
)  # fmt: skip
LEFT = (0, 9)
CERTAIN_DELAY = (3.0, 10.0)  # of a delay that is told: in standard deviations, and in milliseconds
TOLD_DELAY_MS = 25.0  # the largest deviation of a delay that counts as measured
MOST_DELAY_MS = 300.0  # a larger one is a rotation


def table(cameras: Items[CameraEstimate]) -> str:
    """One row a camera."""
    rows = [HEADER, *map(_row, cameras)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if place in LEFT else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def rig_text(whole: RigEstimate, cameras: Items[CameraEstimate]) -> str:
    """Lines about the whole rig, and about the capture times of its cameras."""
    pitch, roll = (f"{a:+.2f}° ± {d:.2f}°" for a, d in zip(whole.tilt_deg, whole.tilt_deviation_deg, strict=True))
    lines = [
        f"height of the rig over the road off by {_metres(whole.height_m, whole.height_deviation_m)}; "
        f"tilt of the ego frame: pitch {pitch}, roll {roll}",
        f"scale of the ego-motion off by {-100 * whole.scale:+.1f} % ± {100 * whole.scale_deviation:.1f} %",
    ]
    lines += [f"time offset: {text}" for each in cameras for text in (delay_text(each), either_text(each)) if text]
    return "\n".join(lines)


def delay_text(estimate: CameraEstimate) -> str:
    """A time offset that is certain, in words; "" where there is none."""
    deviations, least = CERTAIN_DELAY
    size, deviation = abs(estimate.delay_ms), estimate.delay_deviation_ms
    if deviation > TOLD_DELAY_MS or size < max(deviations * deviation, least):
        return ""
    word = _word(estimate.delay_ms)
    return f"the images of {estimate.camera} were taken {size:.0f} ± {deviation:.0f} ms {word} than stated"


def either_text(estimate: CameraEstimate) -> str:
    """A time offset or a rotation, in words, where the motion does not tell which of both; "" where it does.

    A vehicle that turns evenly moves a late camera as if it were turned.
    """
    rotation, covariance = estimate.change[:3], estimate.covariance
    if estimate.verdict is Verdict.FINE or estimate.delay_deviation_ms <= TOLD_DELAY_MS:
        return ""
    gain = np.linalg.solve(covariance[:3, :3], covariance[:3, 6])
    delay_ms = 1000 * float(estimate.change[6] - gain @ rotation)  # if the stated rotation is right
    deviation_ms = 1000 * float(np.sqrt(max(covariance[6, 6] - gain @ covariance[:3, 6], 0)))
    certain = max(CERTAIN_DELAY[0] * deviation_ms, CERTAIN_DELAY[1])
    if deviation_ms > TOLD_DELAY_MS or not certain <= abs(delay_ms) <= MOST_DELAY_MS:
        return ""
    turned = rotation - covariance[:3, 6] / covariance[6, 6] * estimate.change[6]  # if the stated times are right
    return (
        f"the images of {estimate.camera} were taken {abs(delay_ms):.0f} ms {_word(delay_ms)} than stated, or it is "
        f"turned by {np.degrees(np.linalg.norm(turned)):.1f}°: the drive does not tell which of both"
    )


def _word(delay_ms: float) -> str:
    return "later" if delay_ms > 0 else "earlier"


def change_text(estimate: CameraEstimate) -> str:
    """How far a camera is off, in words: "off by yaw +1.98° ± 0.05°, z +0.150 m ± 0.005 m", and so on."""
    rotation = zip(("yaw", "pitch", "roll"), estimate.rotation_deg, estimate.rotation_deviation_deg, strict=True)
    position = zip("xyz", estimate.position_m, estimate.position_deviation_m, strict=True)
    parts = [f"{name} {value:+.2f}° ± {deviation:.2f}°" for name, value, deviation in rotation]
    parts += [f"{name} {value:+.3f} m ± {deviation:.3f} m" for name, value, deviation in position if value]
    return "off by " + ", ".join(parts)


def _row(estimate: CameraEstimate) -> tuple[str, ...]:
    if estimate.verdict is Verdict.NOT_MEASURABLE:
        cells = ["–"] * 6
    else:
        pairs = zip(estimate.rotation_deg, estimate.rotation_deviation_deg, strict=True)
        cells = [f"{value:+.2f}±{deviation:.2f}°" for value, deviation in pairs]
        places = zip(estimate.position_m, estimate.position_deviation_m, strict=True)
        cells += [_metres(value, deviation) for value, deviation in places]
    verdict = estimate.verdict.value + (f": {estimate.reason}" if estimate.reason else "")
    residual = f"{estimate.before_px:.2f} → {estimate.after_px:.2f}" if estimate.matches else "–"
    return (estimate.camera, *cells, f"{estimate.matches}", residual, verdict)


def _metres(value: float, deviation: float) -> str:
    return f"{value:+.3f}±{deviation:.3f} m"
