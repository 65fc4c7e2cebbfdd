"""`bevcli project-debug`: find mistakes in a calibration."""

import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from bevcli.cli.bridge import INPUT, Json, Part, as_flags
from bevcli.printing import say
from bevcli.rig.options import CheckOptions
from bevcli.sequences.format import option_classes
from bevcli.sequences.options import SequenceOptions

PANEL = "Look"
ERRORS_FOUND = 3


def project_debug(
    calibration: Annotated[
        Path, typer.Argument(help="A calibration.json, a sequence that contains one, or a ROS bag."), INPUT
    ],
    source: Annotated[SequenceOptions, Part(only=("allow_outside",))],
    format_options: Annotated[dict[str, Any], Part(only=("topics", "topics_file"), classes=option_classes)],
    options: CheckOptions,
    as_json: Json = False,
) -> None:
    """Find mistakes in a calibration.

    Checks the camera poses and lenses, the bev frame and, with a sequence, its ego-motion and timestamps. Writes
    cameras.png (pillars, ground grid and horizon in each image), coverage.png (how many cameras see each BEV cell),
    recording.rrd (for bevcli viz) and findings.json. Existing files are overwritten.

    Exit code: 0 without errors, 3 with findings of severity error.
    """
    from bevcli.config import load_config
    from bevcli.inference.training_rigs import rig_notes
    from bevcli.rig.check_calibration import check_calibration
    from bevcli.rig.rig_report import INDENT, WIDTH

    given = {name: value for name, value in format_options.items() if value}
    check = check_calibration(calibration, options.sequence, options.frame, allow_outside=source.allow_outside, **given)
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
