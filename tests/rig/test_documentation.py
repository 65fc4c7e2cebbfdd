"""docs/calibration.md lists every kind of finding, and none that does not exist."""

import re
from pathlib import Path

import bevcli

PACKAGE = Path(bevcli.__file__).parent
DOCUMENT = PACKAGE.parent / "docs" / "calibration.md"
SOURCES = [*PACKAGE.glob("geometry/rig_*.py"), *PACKAGE.glob("cli/project_debug*.py")]
SOURCES += [
    PACKAGE / f"sequences/{name}.py" for name in ("calibration", "calibration_fields", "field_report", "pose_field")
]
NOT_CODES = {"project-debug", "cells-seen"}  # the command; a row of the comparison with nuScenes
BUILT_CODES = {"looks-at-ground", "looks-at-sky"}


def test_every_code_is_explained():
    code = re.compile(r'"([a-z]+(?:-[a-z]+)+)"')
    in_sources = {found for path in SOURCES for found in code.findall(path.read_text())} - NOT_CODES | BUILT_CODES
    explained = set(re.findall(r"`([a-z]+(?:-[a-z]+)+)`", DOCUMENT.read_text()))
    assert in_sources == explained


def test_the_images_are_there():
    for image in re.findall(r"\]\((images/[^)]+)\)", DOCUMENT.read_text()):
        assert (DOCUMENT.parent / image).stat().st_size > 10_000
