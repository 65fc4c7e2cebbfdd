"""`bevcli calibrate`: measure the calibration of a drive from its own images and ego-motion."""

from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import FormatValues, InputDrive, Json, Part, as_flags
from bevcli.printing import say
from bevcli.sequences.options import SequenceOptions
from bevcli.workshop.calibration.options import CalibrateOptions, CalibrateOutputOptions

PANEL = "Look"


def calibrate(
    sequence: InputDrive,
    options: CalibrateOptions,
    source: Annotated[SequenceOptions, Part(only=("frames", "scene", "rate_hz", "every", "allow_outside"))],
    format_options: FormatValues,
    output: CalibrateOutputOptions,
    as_json: Json = False,
) -> None:
    """Measure the calibration of a drive from its own images and ego-motion.

    Prints one row a camera: how far its stated rotation and position are off, with standard deviations, and a verdict:
    fine, corrected, or not measurable. Writes calibration.json with the corrected rig and report.json with all numbers.
    Nothing in SEQUENCE is changed. `bevcli run SEQUENCE --calibration FILE` uses the corrected rig.
    """
    from bevcli.cli.progress import Progress
    from bevcli.sequences.open import open_sequence
    from bevcli.workshop.calibration.calibrate import STEPS, calibrate as measure
    from bevcli.writing import check_output

    drive = open_sequence(sequence, source, ego_motion="optional", ground_truth=False, **format_options)
    out = output.out or Path("runs") / f"{drive.name}-calibrate"
    check_output(out / "calibration.json", sequence / "calibration.json")
    with Progress(STEPS, "steps", drive.notes) as progress:
        result = measure(drive, options, after_step=progress.advance)
    written = result.write(out)
    say(result.to_json() if as_json else as_flags(result.text()))
    say("Written: " + ", ".join(map(str, written)), err=as_json)
