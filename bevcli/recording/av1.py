"""Images of one camera as an AV1 stream, encoded by PyAV, an optional package."""

import os
from fractions import Fraction

import av
import numpy as np
from numpy.typing import NDArray

AV1_QUALITY = 30  # SVT-AV1's crf: 0 to 63, lower is better
AV1_PRESET = 9  # SVT-AV1's speed: 0 to 13, higher is faster
KEYFRAME_EVERY = 10  # frames; the viewer decodes from a keyframe on when it jumps to a frame


class Av1Encoder:
    """Encodes the images of one camera, in order; the data of each image is complete when `encode` returns.

    An image with an odd width or height gets another row or column that repeats its last one.
    """

    def __init__(self, width: int, height: int) -> None:
        os.environ.setdefault("SVT_LOG", "1")  # the encoder writes its settings to stderr otherwise
        self._pad = height % 2, width % 2
        self._context = av.CodecContext.create("libsvtav1", "w")
        assert isinstance(self._context, av.VideoCodecContext)
        self._context.width, self._context.height = width + self._pad[1], height + self._pad[0]
        self._context.pix_fmt = "yuv420p"
        self._context.time_base, self._context.framerate = Fraction(1, 1), Fraction(1, 1)
        self._context.gop_size = KEYFRAME_EVERY
        low_delay = "pred-struct=1:lookahead=0:rtc=1:lp=2"
        self._context.options = {"preset": str(AV1_PRESET), "crf": str(AV1_QUALITY), "svtav1-params": low_delay}
        self._count = 0

    def encode(self, pixels_bgr: NDArray[np.uint8]) -> tuple[bytes, bool]:
        """The data of an image (H, W, 3), and whether it can be decoded without the images before it."""
        if any(self._pad):
            pixels_bgr = np.pad(pixels_bgr, ((0, self._pad[0]), (0, self._pad[1]), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels_bgr), format="bgr24")
        frame = frame.reformat(format="yuv420p")
        frame.pts, self._count = self._count, self._count + 1
        (packet,) = self._context.encode(frame)
        return bytes(packet), bool(packet.is_keyframe)

    def close(self) -> None:
        """Ends the stream and frees the encoder."""
        self._context.encode(None)
