"""Folders of images as they lie on disk, without frames.csv: times in names, cameras that do not fire together."""

import random
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.sequences.native.folder import FolderDrive
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats.matching import match_names

START_S = 1_772_366_400  # 2026-03-01 12:00:00 in UTC


def images(drive: Path, names: dict[str, list[str]], inside: str = "images") -> Path:
    """Replace the images of the small drive by others, which are not opened. names: by folder, without suffix."""
    for path in (*drive.rglob("*.png"), drive / "frames.csv"):
        path.unlink()
    for folder in (*(drive / "images").iterdir(), drive / "images"):
        folder.rmdir()
    for folder, stems in names.items():
        (drive / inside / folder).mkdir(parents=True)
        for stem in stems:
            (drive / inside / folder / f"{stem}.jpg").touch()
    return drive


def both(names: list[str]) -> dict[str, list[str]]:
    """The same names for both cameras."""
    return {"CAM_FRONT": names, "CAM_BACK": names}


def opened(drive: Path, names: list[str], **options):
    """The small drive with both cameras' images under these names, standing still, and the line about them."""
    sequence = open_sequence(images(drive, both(names)), ego_motion="static", **options)
    return sequence, next(note for note in sequence.notes if "frames.csv is missing" in note)


def seconds(sequence) -> list[float]:
    """Times of the frames after the first, seconds."""
    return [(stamp.timestamp_ns - sequence.stamps[0].timestamp_ns) / 1e9 for stamp in sequence.stamps]


def jittered(rate: float, seed: int, count: int = 40, jitter_s: float = 0.004) -> list[float]:
    generator = random.Random(seed)
    return [n / rate + generator.uniform(-jitter_s, jitter_s) for n in range(count)]


def poses(drive: Path, start_s: float, count: int = 400) -> None:
    """Poses at 100 Hz from a time on, of a vehicle at 10 m/s."""
    times = [round(start_s * 1e9) + n * 10_000_000 for n in range(count)]
    rows = [f"{time},{n / 10},0,0,1,0,0,0" for n, time in enumerate(times)]
    (drive / "ego_motion.csv").write_text("\n".join(["timestamp_ns,x,y,z,qw,qx,qy,qz", *rows]))


DATES = [datetime(2026, 3, 1, 12, tzinfo=UTC) + timedelta(seconds=n / 12) for n in range(40)]
WAYS = {  # names, hertz, what the line says, start in seconds or None
    "seconds": ([str(START_S + n) for n in range(40)], 1, "seconds since 1970", START_S),
    "decimals": ([f"{START_S + n / 12:.6f}" for n in range(40)], 12, "seconds since 1970", START_S),
    "decimals of any length": ([str(START_S + n / 8) for n in range(40)], 8, "seconds since 1970", START_S),
    "decimals since boot": ([f"{312.5 + n / 12:.4f}" for n in range(40)], 12, "seconds", 312.5),
    "seconds and nanoseconds": ([f"{START_S + n // 4}_{n % 4 * 250000000:09d}" for n in range(40)], 4,
                                "seconds since 1970", START_S),
    "milliseconds": ([f"img_{START_S * 1000 + n * 100}" for n in range(40)], 10, "milliseconds since 1970", START_S),
    "microseconds": ([f"CAM_{START_S * 10**6 + n * 10**5}" for n in range(40)], 10, "microseconds since 1970", START_S),
    "nanoseconds": ([f"{START_S * 10**9 + n * 5 * 10**8}" for n in range(40)], 2, "nanoseconds since 1970", START_S),
    "microseconds since boot": ([f"{5_312_000 + n * 83_333}" for n in range(40)], 12, "microseconds", 5.312),
    "nanoseconds since boot": ([f"{10**12 + n * 33_333_333}" for n in range(40)], 30, "nanoseconds", 1000),
    "milliseconds with steps of 500": ([f"{n * 500:07d}" for n in range(40)], 2, "milliseconds", 0),
    "nuscenes": ([f"n015-2018-07-24-11-22-45+0800__{START_S * 10**6 + n * 83_333}" for n in range(40)], 12,
                 "microseconds since 1970", START_S),
    "a counter and a time": ([f"{START_S * 10**6 + n * 10**5}_{n:04d}" for n in range(40)], 10,
                             "microseconds since 1970", START_S),
    "dates": ([f"{20260301120000 + n}" for n in range(40)], 1, "dates in UTC", START_S),
    "dates with fractions": ([f"{each:%Y-%m-%d_%H-%M-%S.%f}" for each in DATES], 12, "dates in UTC", START_S),
    "dates and milliseconds": ([f"{each:%Y%m%d%H%M%S%f}"[:-3] for each in DATES], 12, "dates in UTC", START_S),
    "counters": ([f"fl_{n:04d}" for n in range(40)], 2, "at 2 Hz (assumed", 0),
    "some of the images": (["3", "17", "40", "51", "90", "95"], None, "at 2 Hz (assumed", 0),
    "a date of the drive and counters": ([f"20260301_120000_{n:05d}" for n in range(40)], 2, "at 2 Hz (assumed", 0),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_the_unit_of_names_is_found(drive, way):
    names, rate, said, start = WAYS[way]
    sequence, line = opened(drive, names)
    assert said in line
    assert len(sequence.stamps) == len(names)
    if rate is not None:
        np.testing.assert_allclose(seconds(sequence), np.arange(len(names)) / rate, atol=2e-3)
    np.testing.assert_allclose(sequence.stamps[0].timestamp_ns / 1e9, start, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_milliseconds_with_jitter_are_no_indices(drive, seed):
    """40 images at 30 Hz, up to 4 ms early or late, of which some are lost."""
    times = [time for n, time in enumerate(jittered(30, seed)) if n % 9 != 8]
    sequence, line = opened(drive, [f"{round(time * 1000) + 4000:06d}" for time in times])
    assert "times are milliseconds, 2 cameras at" in line
    np.testing.assert_allclose(seconds(sequence), np.array(times) - times[0], atol=1.1e-3)


def test_two_possible_readings_need_the_option(drive):
    """0, 100, 200, … are milliseconds at 10 Hz, or every hundredth image."""
    names = [f"{n * 100:06d}" for n in range(20)]
    with pytest.raises(
        InputError,
        match=r'milliseconds \(10 Hz\) or indices of images: pass `times="ms"` .* or `times="index"`',
    ):
        opened(drive, names)
    standing = {"ego_motion": "static"}
    assert seconds(open_sequence(drive, times="ms", **standing))[:3] == [0, 0.1, 0.2]
    assert seconds(open_sequence(drive, times="index", image_rate_hz=500, **standing))[:3] == [0, 0.2, 0.4]
    (drive / "timing.toml").write_text('times = "ms"\nstart_ns = 5000000000\n')
    assert open_sequence(drive, **standing).stamps[1].timestamp_ns == 5_100_000_000


def test_seconds_since_1970_may_be_milliseconds(drive):
    """Images every 10 s by their Unix time, or at 100 Hz on a computer that was started 20 days ago."""
    with pytest.raises(InputError, match=r"seconds since 1970 \(0.1 Hz\) or milliseconds \(100 Hz\): pass `times"):
        opened(drive, [str(1_700_000_000 + 10 * n) for n in range(20)])
    assert seconds(open_sequence(drive, times="s", ego_motion="static"))[1] == 10


def test_the_poses_decide_between_two_readings(drive):
    poses(drive, 0)
    images(drive, both([f"{n * 100:06d}" for n in range(20)]))
    assert seconds(open_sequence(drive))[:3] == [0, 0.1, 0.2]
    poses(drive, 5000)
    with pytest.raises(InputError, match=r"numbered 0 to 1900, and the poses cover 4.0 s.*`image_rate_hz`.*`start_ns`"):
        open_sequence(drive)
    poses(drive, 5000, count=1901)
    sequence = open_sequence(drive)
    assert any("with the times of the 1901 poses (100.0 Hz)" in note for note in sequence.notes)
    assert seconds(sequence)[:3] == [0, 1, 2]


def test_numbered_images_with_poses_without_times_need_a_rate(drive):
    (drive / "ego_motion.csv").unlink()
    (drive / "kitti.txt").write_text("\n".join(f"1 0 0 {n} 0 1 0 0 0 0 1 0" for n in range(5)))
    images(drive, both([f"{n:06d}" for n in range(5)]))
    poses_of = {"ego_motion_file": drive / "kitti.txt", "poses_of": "vehicle"}
    with pytest.raises(InputError, match=r"numbered 0 to 4, and there are poses: state .* by `image_rate_hz`"):
        open_sequence(drive, **poses_of)
    assert seconds(open_sequence(drive, image_rate_hz=10, **poses_of)) == [0, 0.1, 0.2, 0.3, 0.4]


def test_local_dates_are_moved_to_the_time_of_the_poses(drive):
    """The clock of the images shows 14:00 where the poses, since 1970, begin at 12:00 in UTC."""
    poses(drive, START_S)
    sequence = open_sequence(images(drive, both(["20260301140001", "20260301140002"])))
    assert sequence.stamps[0].timestamp_ns == (START_S + 1) * 10**9
    assert any("dates in UTC+2" in note for note in sequence.notes)


def test_frames_before_the_first_pose_are_left_out(drive):
    poses(drive, START_S + 0.5)
    names = [str(round((START_S + n / 10) * 1e6)) for n in range(20)]
    sequence = open_sequence(images(drive, both(names)))
    assert len(sequence.stamps) == 15
    assert any("5 frames outside of the poses left out" in note for note in sequence.notes)


@pytest.mark.parametrize(
    ("names", "options", "expected"),
    [
        ([f"{10**14 + n * 250 * 10**9}" for n in range(5)], {}, r"no times of a camera in any unit.*`times`"),
        (["a_1", "a_2", "a_3_4"], {}, r"a_3_4 has 2 numbers, and a_1 has 1: rename"),
        ([f"{START_S}{n}00000" for n in range(5)], {"times": "ms"}, r"expected milliseconds, different"),
        (["1", "2", "3"], {"image_rate_hz": 1e-300}, r"expected images per second, 0.001 or more"),
        (["1", "2", "3"], {"start_ns": 10**30}, r"expected nanoseconds, at most"),
        (["1", "2", "3"], {"times": "date"}, r"expected dates such as 20260301120000, different"),
        (["a1", "b1"], {"times": "index"}, r"expected indices, different in each image of a camera, found a1"),
    ],
)  # fmt: skip
def test_names_without_a_reading_are_refused(drive, names, options, expected):
    with pytest.raises(InputError, match=expected):
        opened(drive, names, **options)


@pytest.mark.parametrize("lost", [None, "CAM_FRONT", "CAM_BACK"])
def test_cameras_that_do_not_fire_together_are_matched(drive, lost):
    """The back camera follows by 9 ms; both are up to 4 ms early or late. Image 7 of one of them is missing."""
    times = {"CAM_FRONT": jittered(10, 1), "CAM_BACK": [0.009 + time for time in jittered(10, 2)]}
    names = {camera: [f"{camera}_{START_S * 10**6 + round(time * 1e6)}" for time in of] for camera, of in times.items()}
    if lost:
        del names[lost][7]
    sequence = FolderDrive(images(drive, names), InputOptions(ego_motion="static"))
    (line,) = (note for note in sequence.notes if "frames.csv is missing" in note)
    farthest = max(abs(a - b) for a, b in zip(*times.values(), strict=True))
    assert "times are microseconds since 1970, 2 cameras at 10.0 Hz, matched to CAM_FRONT within" in line
    assert lost or f"within {np.ceil(farthest * 1e3):.0f} ms, none of 80 images missing" in line
    assert not lost or "1 of 80 images missing" in line
    assert len(sequence.stamps) == 40
    for place, entry in enumerate(sequence._entries):
        expected = {"CAM_FRONT", "CAM_BACK"} - ({lost} if place == 7 else set())
        assert entry.sources.keys() == expected
        for camera in expected:
            assert entry.sources[camera].timestamp_ns == START_S * 10**9 + round(times[camera][place] * 1e6) * 1000
    if lost:
        assert f"the folder {lost} has no image within 50 ms" in sequence._entries[7].dropped[lost]


def test_the_slowest_camera_sets_the_frames(drive):
    names = {
        "CAM_FRONT": [f"{n * 33_333}" for n in range(60)],
        "CAM_BACK": [f"{11_000 + n * 100_000}" for n in range(20)],
    }
    sequence = open_sequence(images(drive, names), ego_motion="static")
    assert seconds(sequence) == [n / 10 for n in range(20)]
    assert any("2 cameras at 10.0 to 30.0 Hz, matched to CAM_BACK within" in note for note in sequence.notes)


@pytest.mark.parametrize("inside", ["images", "."])
def test_folders_of_cameras_may_have_other_names(drive, inside):
    names = {"front": ["fr_0001", "fr_0002"], "Back": ["bk_0001", "bk_0002"]}
    sequence = open_sequence(images(drive, names, inside), ego_motion="static")
    assert any(note.endswith("; front is CAM_FRONT, Back is CAM_BACK") for note in sequence.notes)
    assert [stamp.index for stamp in sequence.stamps] == [1, 2]
    if inside == ".":  # a folder of cameras alone is a drive
        calibration = (drive / "calibration.json").rename(drive.parent / "rig.json")
        (drive / "ego_motion.csv").unlink()
        assert len(open_sequence(drive, calibration=calibration, ego_motion="static").stamps) == 2


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (["cam_front", "CAM_FRONT_LEFT"], {"CAM_FRONT": "cam_front", "CAM_FRONT_LEFT": "CAM_FRONT_LEFT"}),
        (["f", "fl"], {"CAM_FRONT": "f", "CAM_FRONT_LEFT": "fl"}),
        (["frontLeft", "camera_front"], {"CAM_FRONT": "camera_front", "CAM_FRONT_LEFT": "frontLeft"}),
        (["front", "Cam-Front", "left"], {}),  # ambiguous, and not the same
    ],
)
def test_names_of_cameras_match_where_it_is_unambiguous(found, expected):
    assert match_names(("CAM_FRONT", "CAM_FRONT_LEFT"), found) == expected
