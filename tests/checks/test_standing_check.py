"""Images that move are seen, on real and on rendered drives; those of a vehicle that stands in traffic are not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import MINI_TOML, command

from bevcli.sequences.open import open_sequence
from bevcli.workshop.checks.standing_check import StandingCheck

SAMPLE = Path(__file__).parents[2] / "samples/street"


def warned_at(frames) -> int | None:
    """The first frame, by its place, at which the images are said to move."""
    check = StandingCheck()
    return next((place for place, frame in enumerate(frames) if check.images_move(frame)), None)


def frames_of(path: Path, count: int):
    drive = open_sequence(path, ego_motion="static", ground_truth=False)
    return [drive.load(place) for place in range(min(count, len(drive.stamps)))]


@pytest.fixture(scope="module")
def street():
    """Nine frames of a vehicle that drives off, with two of its cameras."""
    two = ("CAM_FRONT", "CAM_BACK")
    return [replace(frame, images={name: frame.images[name] for name in two}) for frame in frames_of(SAMPLE, 9)]


def with_pixels(frame, change):
    images = {name: replace(image, pixels_bgr=change(name, image.pixels_bgr)) for name, image in frame.images.items()}
    return replace(frame, images=images)


@pytest.fixture(scope="module")
def standing(street):
    """The first frame again and again: a bus passes in each image, the light changes, and pixels are noisy."""
    random = np.random.default_rng(0)

    def seen(place):
        def change(name, pixels):
            height, width = pixels.shape[:2]
            start, bus = place * width // 8, street[place].images[name].pixels_bgr
            changed = pixels.copy()
            changed[height // 4 :, start : start + width // 3] = bus[height // 4 :, start : start + width // 3]
            noisy = changed * (0.9 + 0.02 * place) + random.integers(-8, 9, pixels.shape, np.int8)
            return noisy.clip(0, 255).astype(np.uint8)

        return change

    return [with_pixels(street[0], seen(place)) for place in range(len(street))]


def test_a_rendered_drive_moves(street):
    assert warned_at(street) in range(2, 8)
    assert warned_at([with_pixels(frame, lambda _, pixels: pixels[::2, ::2]) for frame in street]) in range(2, 8)


def test_other_road_users_do_not_move_the_vehicle(standing):
    assert warned_at(standing) is None
    lost = [replace(frame, images={}) if place in (0, 4) else frame for place, frame in enumerate(standing)]
    assert warned_at(lost) is None


def test_a_vehicle_that_drives_off_later_is_seen(street, standing):
    assert warned_at([*standing, *street[4:], *street[4:]]) is not None


def test_noise_and_darkness_say_nothing(street):
    random = np.random.default_rng(0)

    def noise(name, pixels):
        return random.integers(0, 255, pixels.shape, np.uint8)

    assert warned_at([with_pixels(frame, noise) for frame in street[:5]]) is None
    assert warned_at([with_pixels(frame, lambda _, pixels: pixels // 30) for frame in street]) is None
    assert warned_at([replace(frame, images={}) for frame in street]) is None


@pytest.mark.parametrize("name", ["kitti-straight", "nuscenes-scene-0103"])
def test_real_drives_move(name, shared):
    frames = frames_of(shared / "data" / name, 4)
    assert warned_at(frames) == 3
    assert warned_at([frames[0]] * 9) is None


def test_a_real_vehicle_that_stands_is_not_said_to_move(shared):
    drive = open_sequence(shared / "data/dgp-scene_01", ground_truth=False)
    assert drive.ego_motion.velocities == pytest.approx(0, abs=0.1)
    frames = [drive.load(place) for place in range(len(drive.stamps))]
    assert warned_at([*frames, *frames[::-1], *frames]) is None


@pytest.mark.parametrize("static", [("--static",), pytest.param(("--static", "--no-temporal"), marks=pytest.mark.slow)])
def test_a_run_advises_no_history(static, tmp_path):
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    run = ("run", str(SAMPLE), "--model", "mini.toml", "--untrained", "--frames", "4:10", "--no-track")
    said = command(tmp_path, *run, *static).stderr
    warning = 'the images move as if the vehicle drove, but `ego_motion="static"` (`--static`) says that it stands'
    advice = "pass `odometry=True` (`--odometry`) in its place, which measures the motion, or `temporal=False`"
    assert (warning in said and advice in said) == (static == ("--static",))
