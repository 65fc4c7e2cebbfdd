"""Image files that never end, that are huge, or that lie outside of the folder."""

import json
import os
import resource
import shutil
import struct

import cv2
import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.parsing.images import decode_image, size_of_image
from bevcli.sequences.open import open_sequence


def jpeg_of_size(width: int, height: int) -> bytes:
    """A valid small JPEG whose header states another size."""
    encoded = cv2.imencode(".jpg", np.zeros((36, 64, 3), np.uint8))[1].tobytes()
    place = encoded.index(b"\xff\xc0")
    return encoded[: place + 5] + struct.pack(">HH", height, width) + encoded[place + 9 :]


def png_of_size(width: int, height: int) -> bytes:
    encoded = cv2.imencode(".png", np.zeros((36, 64, 3), np.uint8))[1].tobytes()
    return encoded[:16] + struct.pack(">II", width, height) + encoded[24:]


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("target", ["pipe", "/dev/zero", "folder"])
def test_only_regular_files_are_images(drive, target, strict):
    path = drive / "images/CAM_BACK/1.png"
    path.unlink()
    if target == "pipe":
        os.mkfifo(path)
    elif target == "folder":
        path.mkdir()
    else:
        path.symlink_to(target)
    sequence = open_sequence(drive, strict=strict, allow_outside=True)
    if strict:
        with pytest.raises(InputError, match="regular file"):
            sequence.load(1)
    else:
        assert "is not a regular file" in sequence.load(1).dropped["CAM_BACK"]
    with (drive / "images/CAM_BACK/0.png").open("ab") as file:
        file.truncate(1 << 40)
    assert "the file has" in open_sequence(drive).load(0).dropped["CAM_BACK"]


@pytest.mark.parametrize("encoded", [jpeg_of_size(60_000, 60_000), png_of_size(60_000, 60_000)], ids=["jpeg", "png"])
@pytest.mark.parametrize("place", [0, 1])
def test_the_size_is_checked_before_decoding(drive, encoded, place):
    (drive / f"images/CAM_BACK/{place}.png").write_bytes(encoded)
    sequence = open_sequence(drive)
    if place == 0:  # no image of the camera fitted so far: the calibration is for other images
        with pytest.raises(InputError, match=r"is 60000x60000 \(expected 64x36"):
            sequence.load(place)
    else:
        sequence.load(0)
        assert "is 60000x60000 (expected 64x36" in sequence.load(place).dropped["CAM_BACK"]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_header_states_the_size_of_the_image(suffix):
    for height, width in ((1, 1), (36, 64), (900, 1600)):
        encoded = cv2.imencode(suffix, np.zeros((height, width, 3), np.uint8))[1].tobytes()
        assert size_of_image(encoded) == (width, height)
        assert decode_image(encoded, cv2.IMREAD_COLOR, width * height).shape == (height, width, 3)
        assert decode_image(encoded, cv2.IMREAD_COLOR, width * height - 1) is None
        for cut in range(min(len(encoded), 200)):
            size_of_image(encoded[:cut])
            assert decode_image(encoded[:cut], cv2.IMREAD_COLOR, width * height) is None


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_bytes_after_the_end_of_an_image_do_not_matter(suffix):
    pixels = np.random.default_rng(0).integers(0, 255, (36, 64, 3), dtype=np.uint8)
    encoded = cv2.imencode(suffix, pixels)[1].tobytes()
    for tail in (b"\0" * 99, b"\xff\xda" * 9, encoded[:-9], b"ftyp\xff\xd8\xff\xda" * 9):
        found = decode_image(encoded + tail, cv2.IMREAD_COLOR, 64 * 36)
        np.testing.assert_array_equal(found, decode_image(encoded, cv2.IMREAD_COLOR, 64 * 36))


def test_a_cut_jpeg_with_a_whole_thumbnail_is_cut():
    encoded = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (36, 64, 3), dtype=np.uint8))[1].tobytes()
    small = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    exif = b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small
    whole = encoded[:2] + exif + encoded[2:]
    assert decode_image(whole, cv2.IMREAD_COLOR, 64 * 36) is not None
    assert decode_image(whole[:-400], cv2.IMREAD_COLOR, 64 * 36) is None


def test_a_png_chunk_longer_than_the_file_is_refused_undecoded():
    encoded = bytearray(cv2.imencode(".png", np.zeros((36, 64, 3), np.uint8))[1].tobytes())
    place = encoded.index(b"IDAT") - 4
    encoded[place : place + 4] = struct.pack(">I", 2**31 - 1)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert decode_image(bytes(encoded), cv2.IMREAD_COLOR, 64 * 36) is None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 100_000  # KiB


def test_the_size_of_a_progressive_jpeg_with_metadata_is_read():
    image = np.zeros((36, 64, 3), np.uint8)
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    # Metadata that contains what looks like another header.
    other = b"\xff\xc0\x00\x11\x08" + struct.pack(">HH", 9, 9) + bytes(10)
    encoded = encoded[:2] + b"\xff\xe1" + struct.pack(">H", len(other) + 2) + other + encoded[2:]
    assert size_of_image(encoded) == (64, 36)


def outside(drive, kind):
    """Moves an image out of the folder, to where `kind` leads."""
    elsewhere = drive.parent / "elsewhere.png"
    shutil.copy(drive / "images/CAM_BACK/1.png", elsewhere)
    table = drive / "frames.csv"
    if kind == "link":
        (drive / "images/CAM_BACK/1.png").unlink()
        (drive / "images/CAM_BACK/1.png").symlink_to(elsewhere)
    elif kind == "linked folder":
        (drive / "images/CAM_BACK").rename(drive.parent / "moved")
        (drive / "images/CAM_BACK").symlink_to(drive.parent / "moved")
    else:
        cell = "../elsewhere.png" if kind == "dots" else str(elsewhere)
        table.write_text(table.read_text().replace("images/CAM_BACK/1.png", cell))


@pytest.mark.parametrize("kind", ["dots", "absolute", "link", "linked folder"])
def test_images_outside_of_the_folder_need_allow_outside(drive, kind):
    outside(drive, kind)
    with pytest.raises(InputError, match=r"leads out of the folder.*`allow_outside=True`"):
        open_sequence(drive).load(1)
    assert "CAM_BACK" in open_sequence(drive, allow_outside=True).load(1).images
    if kind == "dots":  # that lead back into the folder
        table = drive / "frames.csv"
        table.write_text(table.read_text().replace("../elsewhere.png", "images/../images/CAM_BACK/1.png"))
        assert "CAM_BACK" in open_sequence(drive).load(1).images


@pytest.mark.parametrize("name", ["../../evil", "a/b", "..", "", "a\\b", "x" * 300, "a\nb", "/etc"])
def test_a_camera_whose_name_is_no_file_name_is_refused(drive, name):
    path = drive / "calibration.json"
    document = json.loads(path.read_text())
    document["cameras"][name] = document["cameras"].pop("CAM_BACK")
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="name of a camera"):
        open_sequence(drive)


def test_a_playlist_is_not_opened_as_a_video(drive):
    (drive / "frames.csv").unlink()
    shutil.rmtree(drive / "images")
    (drive / "videos").mkdir()
    for name in ("CAM_FRONT", "CAM_BACK"):
        (drive / f"videos/{name}.mp4").write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n")
    with pytest.raises(InputError, match="is not a video"):
        open_sequence(drive)
