"""Images of videos that frames.csv lists, and whole videos aligned by time.

FFV1 is lossless, so pixels are compared exactly.
"""

import shutil
from fractions import Fraction

import cv2
import numpy as np
import pytest
from small_drive import SIZE, image_of

from bevcli.errors import InputError
from bevcli.sequences.images import VideoReader
from bevcli.sequences.native import holds_videos_alone
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.video_file import container_times_ns


def write_video(path, images, rate, codec="FFV1"):
    path.parent.mkdir(exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), rate, SIZE)
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()


@pytest.fixture
def videos(drive):
    """The small drive with videos only: ten front images at 10 Hz, five back images at 5 Hz."""
    (drive / "frames.csv").unlink()
    shutil.rmtree(drive / "images")
    write_video(drive / "videos/CAM_FRONT.mkv", [image_of("CAM_FRONT", n) for n in range(10)], 10)
    write_video(drive / "videos/CAM_BACK.avi", [image_of("CAM_BACK", n) for n in range(5)], 5)
    return drive


@pytest.mark.parametrize("suffix", ["mkv", "avi"])
def test_images_are_read_by_index_in_any_order(tmp_path, suffix):
    images = [image_of("CAM_FRONT", number) for number in range(8)]
    write_video(tmp_path / f"v.{suffix}", images, 10)
    reader = VideoReader(tmp_path / f"v.{suffix}")
    for number in (0, 1, 1, 4, 7, 2, 2, 3):
        np.testing.assert_array_equal(reader.read(number), images[number])
        with pytest.raises(InputError, match=r"no image 8 \(the last is 7\)"):
            reader.read(8)
    odd = (tmp_path / f"v.{suffix}").rename(tmp_path / f"\udcff\udce9.{suffix}")  # OpenCV ends the process at this name
    np.testing.assert_array_equal(VideoReader(odd).read(1), images[1])


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_rotation_tag_leaves_the_pixels_as_stored(videos, degrees):
    plain = videos / "videos/CAM_FRONT.mp4"
    (videos / "videos/CAM_FRONT.mkv").unlink()
    write_video(plain, [image_of("CAM_FRONT", n) for n in range(10)], 10, "mp4v")
    stored = VideoReader(plain).read(0)
    content = bytearray(plain.read_bytes())
    matrix = content.index(b"tkhd") + 44  # of a track: nine numbers of 32 bits, the first two rows in 16.16
    turn = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}[degrees]
    for place, value in zip((0, 4, 12, 16), turn, strict=True):
        content[matrix + place : matrix + place + 4] = (value << 16).to_bytes(4, "big", signed=True)
    plain.write_bytes(content)
    sequence = open_sequence(videos, ego_motion="static")
    assert any("CAM_FRONT.mp4: has a rotation tag" in note for note in sequence.notes)
    np.testing.assert_array_equal(sequence.load(0).images["CAM_FRONT"].pixels_bgr, stored)


def test_cells_of_frames_csv_name_images_of_a_video(drive, edit):
    write_video(drive / "videos/BACK.mkv", [image_of("CAM_BACK", n) for n in range(9)], 10)
    edit("frames.csv", "images/CAM_BACK/0.png", "videos/BACK.mkv#8")
    edit("frames.csv", "images/CAM_BACK/1.png", "videos/BACK.mkv#0")
    edit("frames.csv", "images/CAM_BACK/2.png", "videos/BACK.mkv#9")
    sequence = open_sequence(drive)
    np.testing.assert_array_equal(sequence.load(0).images["CAM_BACK"].pixels_bgr, image_of("CAM_BACK", 8))
    np.testing.assert_array_equal(sequence.load(1).images["CAM_BACK"].pixels_bgr, image_of("CAM_BACK", 0))
    assert "no image 9" in sequence.load(2).dropped["CAM_BACK"]


def test_whole_videos_are_aligned_by_time(videos):
    """There is one frame per back image. The nearest front image has twice its index."""
    sequence = open_sequence(videos, ego_motion="static")
    assert [stamp.timestamp_ns for stamp in sequence.stamps] == [n * 200_000_000 for n in range(5)]
    for place in range(5):
        frame = sequence.load(place)
        np.testing.assert_array_equal(frame.images["CAM_BACK"].pixels_bgr, image_of("CAM_BACK", place))
        np.testing.assert_array_equal(frame.images["CAM_FRONT"].pixels_bgr, image_of("CAM_FRONT", 2 * place))
        assert frame.images["CAM_FRONT"].encoded is None


def test_offsets_and_rates_come_from_timing_toml(videos):
    """Image n of the front camera is at 0.31 + n / 10 s, and that of the back camera at n / 4 s."""
    (videos / "timing.toml").write_text(
        "start_ns = 5000000000\n[cameras.CAM_FRONT]\noffset_ns = 310000000\n[cameras.CAM_BACK]\nrate_hz = 4\n"
    )
    sequence = open_sequence(videos, ego_motion="static")
    assert [stamp.timestamp_ns for stamp in sequence.stamps] == [5_000_000_000 + n * 250_000_000 for n in range(5)]
    assert "CAM_FRONT" in sequence.load(0).dropped
    assert "CAM_FRONT" in sequence.load(1).dropped  # 0.25 s is 60 ms before its first image
    for place, number in ((2, 2), (3, 4), (4, 7)):
        image = sequence.load(place).images["CAM_FRONT"]
        assert image.timestamp_ns == 5_310_000_000 + number * 100_000_000
        np.testing.assert_array_equal(image.pixels_bgr, image_of("CAM_FRONT", number))


def test_poses_are_taken_at_the_images_own_times(videos):
    """The vehicle drives at 10 m/s from x = 0 at time 0; its poses start at 0.9 s."""
    (videos / "timing.toml").write_text("start_ns = 1000000000\n[cameras.CAM_FRONT]\noffset_ns = 30000000\n")
    frame = open_sequence(videos).load(2)
    np.testing.assert_allclose(frame.world_from_ego.translation[0], 14.0, atol=1e-9)
    np.testing.assert_allclose(frame.world_from_ego_at["CAM_FRONT"].translation[0], 14.3, atol=1e-9)


def test_videos_outside_the_ego_motion_need_a_start_time(videos):
    """Without timing.toml, videos start at time 0, before the first pose."""
    with pytest.raises(InputError, match=r"ego_motion.csv: covers .*CAM_BACK.avi#0.*timing.toml"):
        open_sequence(videos)


def test_other_kinds_of_videos_and_none(videos):
    back = videos / "videos/CAM_BACK.avi"
    write_video(back, [image_of("CAM_BACK", n) for n in range(5)], 5, "MJPG")
    assert open_sequence(videos, ego_motion="static").load(4).images["CAM_BACK"].pixels_bgr.shape == (36, 64, 3)
    back.write_bytes(b"no video at all" * 100)
    with pytest.raises(InputError, match=r"CAM_BACK.avi"):
        open_sequence(videos, ego_motion="static")
    back.unlink()
    with pytest.raises(InputError, match="camera CAM_BACK: expected one video"):
        open_sequence(videos, ego_motion="static")


UNEVEN_MS = [0, 500, 1000, 1500, 2000, 3500, 5000, 5040, 6500]
WRITTEN = {
    "plain.mp4": ("mpeg4", {}, {}), "fragments.mp4": ("mpeg4", {}, {"movflags": "frag_keyframe+empty_moov"}),
    "reordered.mov": ("libx264", {"bf": "2", "g": "9"}, {}), "v.mkv": ("ffv1", {}, {}), "v.webm": ("libvpx", {}, {}),
    "live.mkv": ("mpeg4", {}, {"live": "1"}),
    "dash.ts": ("libx264", {"bf": "0"}, {}),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITTEN)
def test_a_video_of_uneven_rate_has_the_times_of_its_container(tmp_path, name):
    """As phones and dashboard cameras write them."""
    av = pytest.importorskip("av")
    codec, options, container_options = WRITTEN[name]
    with av.open(str(tmp_path / name), "w", options=container_options) as container:
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for number, time in enumerate(UNEVEN_MS):
            frame = av.VideoFrame.from_ndarray(image_of("CAM_FRONT", number), format="bgr24").reformat(format="yuv420p")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    np.testing.assert_allclose(container_times_ns(tmp_path / name) / 1e6, UNEVEN_MS, atol=1)
    if name != "live.mkv":  # which does not state how long it is
        how = {"fov_deg": 65, "height": 1.5, "ego_motion": "static"}
        sequence = open_sequence(tmp_path / name, **how, start_ns=10**9)
        np.testing.assert_allclose([each.timestamp_ns / 1e6 - 1000 for each in sequence.stamps], UNEVEN_MS, atol=1)
        assert any("9 images at uneven times, those of the container, from" in note for note in sequence.notes)
        even = open_sequence(tmp_path / name, **how, image_rate_hz=2)
        assert [stamp.timestamp_ns for stamp in even.stamps[:3]] == [0, 500_000_000, 1_000_000_000]


@pytest.mark.parametrize("rate", [10, 29.97])
@pytest.mark.parametrize(("suffix", "codec"), [("mp4", "mp4v"), ("mkv", "FFV1"), ("avi", "FFV1")])
def test_the_times_of_an_even_video_are_those_of_its_rate(tmp_path, rate, suffix, codec):
    path = tmp_path / f"v.{suffix}"
    write_video(path, [image_of("CAM_FRONT", n) for n in range(20)], rate, codec)
    times = container_times_ns(path)
    assert (times is None) == (suffix == "avi")
    sequence = open_sequence(path, fov_deg=65, height=1.5, ego_motion="static")
    assert [each.timestamp_ns for each in sequence.stamps] == [round(n * 1e9 / rate) for n in range(20)]
    assert times is None or np.abs(times - [n * 1e9 / rate for n in range(20)]).max() < 1e6


def test_videos_alone_may_do_without_poses(tmp_path):
    (tmp_path / "videos").mkdir()
    assert holds_videos_alone(tmp_path)
    (tmp_path / "calibration.json").touch()
    assert not holds_videos_alone(tmp_path)
    assert not holds_videos_alone(tmp_path / "videos")


@pytest.mark.parametrize("damage", ["audio only", "cut", "no video"])
def test_a_video_without_images_is_one_line(tmp_path, capfd, damage):
    """What OpenCV prints itself is not seen."""
    path = tmp_path / "v.mp4"
    if damage == "audio only":
        av = pytest.importorskip("av")
        with av.open(str(path), "w") as container:
            stream = container.add_stream("aac", rate=44100, layout="mono")
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate = 44100
            container.mux([*stream.encode(frame), *stream.encode(None)])
    else:
        write_video(path, [image_of("CAM_FRONT", n) for n in range(10)], 10, "mp4v")
        content = path.read_bytes()
        path.write_bytes(content[: content.index(b"mdat") + 8] if damage == "cut" else content[:8] + bytes(2000))
    with pytest.raises(InputError, match=r"v.mp4 cannot be opened as a video: it is cut short, has sound only"):
        open_sequence(path, fov_deg=70, height=1.4)
    assert "VIDEOIO" not in capfd.readouterr().err
