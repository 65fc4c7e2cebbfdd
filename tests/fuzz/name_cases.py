"""Cases of bags whose messages come late or hold no pose, and of drives and outputs with names of any bytes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from random import Random

import numpy as np
from bags import drive_messages, odometry, write_mcap
from command_line import command

from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.sequences.open import open_sequence

LATEST_NS = 1_500_000_000


def bag_order(seeds: Path, case: Path, random: Random) -> None:
    """Messages that are recorded late have the frames of those that are not, and poses that are none are left out."""
    motion = read_ego_motion(seeds / "drive/ego_motion.csv")
    messages = list(drive_messages(open_sequence(seeds / "drive"), motion, poses_in=random.choice(("odometry", "tf"))))
    late = {topic for topic, *_ in messages if random.random() < 0.5}
    moved = [
        (topic, kind, time + (random.randrange(LATEST_NS) if topic in late else 0), fields)
        for topic, kind, time, fields in messages
    ]
    for _ in range(random.randrange(5)):
        time = random.choice(motion.timestamps_ns.tolist()) + 1
        place, rotation = random.choice(((np.nan, 1.0), (np.inf, 1.0), (0.0, 0.0), (0.0, np.nan)))
        bad = odometry(time, "map", "base_link", Pose(np.full(3, place), np.array([rotation, 0, 0, 0])))
        if any(topic == "/odom" for topic, *_ in messages):
            moved.append(("/odom", "nav_msgs/Odometry", time, bad))
    found = open_sequence(write_mcap(case / "late.mcap", moved))
    true = open_sequence(write_mcap(case / "true.mcap", messages))
    assert found.stamps == true.stamps
    for frame, stated in ((found.load(place), true.load(place)) for place in range(len(true.stamps))):
        assert frame.images.keys() == stated.images.keys()
        np.testing.assert_allclose(frame.world_from_ego.matrix, stated.world_from_ego.matrix, atol=1e-9)
        for name, image in stated.images.items():
            np.testing.assert_array_equal(frame.images[name].pixels_bgr, image.pixels_bgr)


def name_bytes(seeds: Path, case: Path, random: Random) -> None:
    """A drive of images or videos is converted, whatever the bytes of its name and of the output's."""
    allowed = [byte for byte in range(1, 256) if byte != ord("/")]
    names = [os.fsdecode(b"x" + bytes(random.choices(allowed, k=random.randrange(1, 40)))) for _ in range(2)]
    source = seeds / random.choice(("drive", "videos_drive"))
    drive = Path(shutil.copytree(source, case / f"in{names[0]}"))
    done = command(case, "convert", str(drive), f"out{names[1]}")
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) == len(command(case, "convert", str(source), "plain").stderr.splitlines())
    assert len(open_sequence(case / f"out{names[1]}").stamps) == len(open_sequence(case / "plain").stamps)
