"""When each camera took its image, against the frame's time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bevcli.findings import Finding

OFFSET_WARNING_S = 0.1  # nuScenes' cameras fire within 0.05 s of the frame
OFFSET_ERROR_S = 0.5
JITTER_WARNING_S = 0.05


def check_camera_times(frame_ns: Sequence[int], camera_ns: Mapping[str, Sequence[int | None]]) -> tuple[Finding, ...]:
    """One finding a camera at most. camera_ns: by camera, for each frame its image's time or None without image.

    Ego-motion makes up for a known offset of a standing scene, not of moving objects; a camera that is half a second
    off is a mistake.
    """
    findings = (_check(name, np.array(frame_ns, dtype=np.int64), times) for name, times in camera_ns.items())
    return tuple(finding for finding in findings if finding is not None)


def _check(name: str, frame_ns: NDArray[np.int64], times: Sequence[int | None]) -> Finding | None:
    offsets = (
        np.array([time - int(frame) for time, frame in zip(times, frame_ns, strict=True) if time is not None]) / 1e9
    )
    if len(offsets) == 0:
        message = "has no image in any frame"
        return Finding("camera-without-images", "warning", name, message, "0", f"{len(times)}", "check its paths")
    offset, jitter = float(np.median(offsets)), float(np.std(offsets))
    found = f"{offset * 1e3:+.0f} ms, spread {jitter * 1e3:.0f} ms"
    advice = "state each image's own time, or shift this camera's images"
    if abs(offset) > OFFSET_ERROR_S:
        message, expected = "its images are far from the frames' times", f"within {OFFSET_ERROR_S * 1e3:g} ms"
        return Finding("time-offset", "error", name, message, found, expected, advice)
    if abs(offset) > OFFSET_WARNING_S or jitter > JITTER_WARNING_S:
        message, expected = "its images are off the frames' times", f"within {OFFSET_WARNING_S * 1e3:g} ms"
        return Finding("time-offset", "warning", name, message, found, expected, advice)
    return None
