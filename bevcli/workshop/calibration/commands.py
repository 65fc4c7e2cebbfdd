"""`bevcli calibrate`: measure the calibration of a drive from its own images and ego-motion."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import FormatValues, InputDrive, Json, Part
from bevcli.cli.progress import Progress, open_with_bar
from bevcli.printing import say
from bevcli.sequences.options import InputOptions
from bevcli.workshop.calibration import CalibrateOptions, CalibrateOutputOptions
from bevcli.writing import check_output

PANEL = "Look"


def calibrate(
    sequence: InputDrive,
    options: CalibrateOptions,
    source: Annotated[InputOptions, Part(only=("frames", "scene", "rate_hz", "every", "odometry", "allow_outside"))],
    format_options: FormatValues,
    output: CalibrateOutputOptions,
    as_json: Json = False,
) -> None:
    """Measure the calibration of a drive from its own images and ego-motion.

    Prints one row a camera: how far its stated rotation and position are off, with standard deviations, and a verdict:
    fine, corrected, or not measurable. Writes calibration.json with the corrected rig and report.json with all numbers.
    Nothing in SEQUENCE is changed. `bevcli run SEQUENCE --calibration FILE` uses the corrected rig. With --odometry the
    motion comes from the images, too: it and the calibration are measured in turn until both stand still.
    """
    from bevcli.workshop.calibration import calibrate as at_once, in_turn

    count, measure = at_once.STEPS, at_once.calibration_steps
    if source.odometry:
        count, measure = in_turn.ALL_STEPS, in_turn.calibrate_in_turn
    input_options = replace(source, odometry=False, ego_motion="measured" if source.odometry else "optional")
    drive = open_with_bar(sequence, replace(input_options, ground_truth=False), format_options)
    out = output.out or Path("runs") / f"{drive.name}-calibrate"
    check_output(out / "calibration.json", sequence / "calibration.json")
    with Progress(count, "steps", drive.notes) as progress:
        result = at_once.last(progress.over(measure(drive, options)))
    written = result.write(out)
    say(result.to_json() if as_json else result.text())
    say("Written: " + ", ".join(map(str, written)), err=as_json)
