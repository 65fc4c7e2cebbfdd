"""Decodes the camera images of a recording, from single images or from AV1 video streams."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.parsing.images import decode_image
from bevcli.recording import entities
from bevcli.recording.video_images import Av1Decoder, require_av
from bevcli.viewer.recording_reader import RecordedFrame

MOST_PIXELS = 64 << 20


class CameraImages:
    """The images of a recording: call `image` once for each camera of each frame, in order."""

    def __init__(self) -> None:
        self._decoders: dict[str, Av1Decoder] = {}

    def image(self, frame: RecordedFrame, camera: str) -> NDArray[np.uint8] | None:
        """The image of a camera, (H, W, 3) uint8 BGR; None if the frame has none. Raises BevcliError without PyAV."""
        entity = entities.image(camera)
        data = frame.blob(entity, "VideoStream:sample")
        if data:
            return self._decoder(camera).decode(data)
        encoded = frame.blob(entity, "EncodedImage:blob")
        image = decode_image(encoded, cv2.IMREAD_COLOR, MOST_PIXELS) if encoded else None
        return None if image is None else image.astype(np.uint8, copy=False)

    def _decoder(self, camera: str) -> Av1Decoder:
        if camera not in self._decoders:
            require_av("the images of this recording are AV1")
            self._decoders[camera] = Av1Decoder()
        return self._decoders[camera]
