"""Images as AV1 video streams: every frame can be decoded, and the file is smaller."""

import cv2
import numpy as np
import pytest
from memory_drive import MemoryDrive, WithoutImages
from recorded_drive import record

from bevcli import recording as options
from bevcli.errors import BevcliError
from bevcli.recording import RecordingOptions, entities
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop.video import Av1Decoder, RecordedImages

if options.has_av():
    from bevcli.recording.av1 import KEYFRAME_EVERY, Av1Encoder

with_av = pytest.mark.skipif(not options.has_av(), reason="PyAV is not installed: pip install 'bevcli[video]'")


def scene(step: int, width: int = 320, height: int = 180) -> np.ndarray:
    """A street-like image without noise: a gradient and a rectangle that moves."""
    image = np.zeros((height, width, 3), dtype=np.uint8)
    image[..., 0] = np.linspace(40, 200, width)
    image[..., 1] = np.linspace(200, 60, height)[:, None]
    image[60:120, 20 + 8 * step : 80 + 8 * step] = (30, 60, 220)
    return image


@with_av
@pytest.mark.parametrize("size", [(320, 180), (321, 181)])
def test_each_image_is_complete_when_it_was_encoded(size):
    encoder, decoder = Av1Encoder(*size), Av1Decoder()
    for step in range(12):
        image = scene(step, *size)
        data, is_keyframe = encoder.encode(image)
        assert is_keyframe == (step % KEYFRAME_EVERY == 0)
        back = decoder.decode(data)[: size[1], : size[0]]
        assert cv2.PSNR(back, image) > 33
    encoder.close()


@with_av
def test_the_images_of_a_recording_come_back(tmp_path):
    class Street(MemoryDrive):
        def load(self, place):
            frame = super().load(place)
            for image in frame.images.values():
                image.pixels_bgr[:] = scene(place)
            return frame

    drive = Street(4)
    record(tmp_path / "av1.rrd", drive, RecordingOptions(images="av1"))
    images = RecordedImages()
    for place, frame in enumerate(RecordingReader(tmp_path / "av1.rrd").frames()):
        assert not frame.has(entities.image("CAM_BACK"), "EncodedImage:blob")
        assert cv2.PSNR(images.image(frame, "CAM_BACK"), scene(place)) > 33


@pytest.mark.slow
@with_av
def test_a_dropped_image_starts_a_new_stream(tmp_path):
    record(tmp_path / "r.rrd", WithoutImages({1: ("CAM_BACK",)}, count=4), RecordingOptions(images="av1"))
    images, shown, keyframes = RecordedImages(), [], []
    for frame in RecordingReader(tmp_path / "r.rrd").frames():
        shown.append(images.image(frame, "CAM_BACK") is not None)
        keyframes.append(frame.values(entities.image("CAM_BACK"), "VideoStream:is_keyframe"))
    assert shown == [True, False, True, True]
    assert keyframes == [[True], [], [True], [False]]


def test_without_pyav_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setattr(options, "has_av", lambda: False)
    said = r"`images=\"av1\"` \(`--images av1`\): PyAV is not installed: pip install 'bevcli\[video\]'"
    with pytest.raises(BevcliError, match=said):
        options.RecordingOptions(images="av1")
