"""docs/calibration.md lists the codes of all findings, and each listed code occurs."""

import re
from pathlib import Path

import numpy as np
import pytest
from healthy_rigs import HEALTHY, copy_of
from memory_drive import MemoryDrive
from mistakes import (
    BEV_MISTAKES,
    FIELD_MISTAKES,
    LENS_MISTAKES,
    LENS_WARNINGS,
    MOTION_MISTAKES,
    POSE_MISTAKES,
    both_rotations,
    drive,
    rounded,
    turned,
    xyzw,
)
from stated_mistakes import MISTAKES, SHOWN
from test_project_debug import calibration, write_drive, write_motion

import bevcli
from bevcli.rig.check_calibration import check_calibration
from bevcli.rig.sequence_checks import check_ego_motion
from bevcli.workshop.calibration.calibrate import findings_of, motion_findings
from bevcli.workshop.calibration.estimates import CameraEstimate, Verdict
from bevcli.workshop.odometry.compare import compare, not_compared

DOCUMENT = Path(bevcli.__file__).parents[1] / "docs" / "calibration.md"
CODE = r"`([a-z]+(?:-[a-z]+)+)`"


def codes_in(document, folder):
    return {finding.code for finding in check_calibration(calibration(document, folder)).findings}


def rig_codes(folder):
    """Findings about rigs: healthy ones, and ones with a single mistake."""
    cases = [copy_of(name) for name in HEALTHY]
    for mistakes, entry in (
        ([*POSE_MISTAKES, ("xyzw", xyzw), ("rounded", rounded), ("both", both_rotations)], "ego_from_camera"),
        ([*LENS_MISTAKES, *LENS_WARNINGS, *FIELD_MISTAKES], None),
    ):
        for mistake in dict(mistakes).values():  # one of each code; test_rig_checks.py has all of them
            document = copy_of("six")
            camera = document["cameras"]["CAM_FRONT_LEFT"]
            mistake(camera[entry] if entry else camera)
            cases.append(document)
    for _, mistake in BEV_MISTAKES:
        document = copy_of("six")
        mistake(document["ego_from_bev"])
        cases.append(document)
    document = copy_of("six")
    turned("z", 10)(document["cameras"]["CAM_FRONT"]["ego_from_camera"])
    return set().union(*(codes_in(case, folder) for case in [*cases, document, *named_rigs(), *bare_rigs()]))


def named_rigs():
    """Rigs whose camera names do not fit the poses."""
    swapped, doubled, turned_ego = copy_of("six"), copy_of("six"), copy_of("six")
    cameras = swapped["cameras"]
    cameras["CAM_FRONT"], cameras["CAM_BACK"] = cameras["CAM_BACK"], cameras["CAM_FRONT"]
    cameras = doubled["cameras"]
    cameras["CAM_BACK_LEFT"]["ego_from_camera"] = cameras["CAM_FRONT_LEFT"]["ego_from_camera"]
    cameras = turned_ego["cameras"]
    names = ["CAM_FRONT", "CAM_FRONT_LEFT", "CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT", "CAM_FRONT_RIGHT"]
    turned_ego["cameras"] = {name: cameras[names[place - 2]] for place, name in enumerate(names)}
    alone = copy_of("six")
    alone["cameras"] = {"back": alone["cameras"]["CAM_FRONT"]}
    return [swapped, doubled, turned_ego, alone]


def bare_rigs():
    """Rigs that lack the format or the bev frame."""
    other_format, no_bev = copy_of("six"), copy_of("six")
    other_format["format"] = "bevcli-boxes/1"
    del no_bev["ego_from_bev"]
    return [other_format, no_bev]


def sequence_codes(folder):
    """Findings about ego-motion, timestamps and images."""
    motion = {f.code for _, spoil in MOTION_MISTAKES.values() for f in check_ego_motion(spoil(drive()))}
    names = ("late", "missing", "refused", "unlisted")
    late, missing, refused, unlisted = drives = [write_drive(folder / name) for name in names]
    table = (late / "frames.csv").read_text().splitlines()
    rows = [row.rsplit(",", 1) for row in table[1:]]
    late_rows = [f"{row},{int(time) + 300_000_000}" for row, time in rows]
    (late / "frames.csv").write_text("\n".join([table[0], *late_rows]))
    without_back = [",".join([*row.split(",")[:3], "", ""]) for row in table[1:]]
    (missing / "frames.csv").write_text("\n".join([table[0], *without_back]))
    write_motion(refused, heading=(1, 0, 0, 0), rows=5)
    (unlisted / "frames.csv").unlink()
    without = check_calibration(late, fov_deg=70, height=1.5, yaw_deg={"CAM_FRONT": 0, "CAM_BACK": 180})
    checks = [without, *map(check_calibration, drives)]
    return motion.union(*({f.code for f in check.findings} for check in checks))


def motion_codes():
    """Findings about what the drive itself shows."""
    late = CameraEstimate(
        "CAM_FRONT", Verdict.CORRECTED, "", (2, 0, 0), (0.1, 0.1, 0.1), (0, 0, 0), (0.1, 0.1, 0.1), 100, 5,
        500, 500, 9, 1, np.zeros(6), np.eye(6),
    )  # fmt: skip
    wrong = {code: poses for poses, code, *_ in MISTAKES.values()}
    of_poses = [finding for poses in wrong.values() for finding in compare(poses, SHOWN)]
    of_calibration = (*findings_of([late]), *motion_findings(MemoryDrive(count=1)))
    return {finding.code for finding in (*of_calibration, *of_poses, not_compared(""))}


@pytest.fixture(scope="module")
def occurring(tmp_path_factory):
    rigs, sequences = (tmp_path_factory.mktemp(name) for name in ("rigs", "sequences"))
    return rig_codes(rigs) | sequence_codes(sequences) | motion_codes()


@pytest.fixture(scope="module")
def documented():
    return set(re.findall(CODE, DOCUMENT.read_text())) - {"project-debug"}


def test_every_finding_that_occurs_is_documented(occurring, documented):
    assert sorted(occurring - documented) == []


def test_every_documented_finding_occurs(occurring, documented):
    assert sorted(documented - occurring) == []


def test_the_images_are_there():
    for image in re.findall(r"\]\((images/[^)]+)\)", DOCUMENT.read_text()):
        assert (DOCUMENT.parent / image).stat().st_size > 10_000
