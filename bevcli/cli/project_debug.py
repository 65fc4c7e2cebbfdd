"""`bevcli project-debug`: find mistakes in a calibration."""

import textwrap
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.bridge import ExtensionsOf, FormatValues, Json, Part, Steps, argument, as_flags
from bevcli.printing import say
from bevcli.rig.options import CheckOptions
from bevcli.sequences.options import SequenceOptions

PANEL = "Look"
ERRORS_FOUND = 3


def project_debug(
    calibration: Annotated[Path, argument("A calibration.json, a sequence that contains one, or a ROS bag.")],
    source: Annotated[SequenceOptions, Part(only=("allow_outside",))],
    format_options: Annotated[FormatValues, Part(only=("topics", "topics_file"))],
    options: CheckOptions,
    further: Annotated[Steps, ExtensionsOf("project-debug")],
    as_json: Json = False,
) -> None:
    """Find mistakes in a calibration.

    Checks the camera poses and lenses, the bev frame and, with a sequence, its ego-motion, its timestamps, and whether
    the images fit how the vehicle moves (the short form of `bevcli calibrate`). Writes
    cameras.png (pillars, ground grid and horizon in each image), coverage.png (how many cameras see each BEV cell),
    recording.rrd (for bevcli viz) and findings.json. Existing files are overwritten.

    Exit code: 0 without errors, 3 with findings of severity error.
    """
    from bevcli.config import load_config
    from bevcli.inference.training_rigs import rig_notes
    from bevcli.rig.check_calibration import check_calibration
    from bevcli.rig.rig_report import INDENT, WIDTH, with_findings
    from bevcli.sequences.open import open_sequence

    given = {name: value for name, value in format_options.items() if value}
    check = check_calibration(calibration, options.sequence, options.frame, allow_outside=source.allow_outside, **given)
    if not check.errors:
        if options.sequence is not None:
            given["calibration"] = calibration
        how = {"ground_truth": False, "allow_outside": source.allow_outside, **given}
        open_drive = partial(open_sequence, options.sequence or calibration, **how)
        findings = [finding for step in further for finding in step(open_drive)]
        check = replace(check, report=with_findings(check.report, findings))
    written = check.write(options.out or Path("runs") / f"{check.name}-project-debug")
    if as_json:
        say(check.to_json())
    else:
        notes = [
            textwrap.fill(f"Model {options.model}: {note}.", WIDTH, subsequent_indent=INDENT) + "\n"
            for note in rig_notes(check.rig, load_config(options.model))
        ]
        say(as_flags(check.text()), "", *notes, "Written: " + ", ".join(map(str, written)))
    if check.errors:
        raise typer.Exit(ERRORS_FOUND)
