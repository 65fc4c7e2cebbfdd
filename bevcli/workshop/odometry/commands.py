"""`bevcli odometry`: measure the motion of the vehicle from the images of a drive."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import FormatValues, InputDrive, Json, Part
from bevcli.printing import say
from bevcli.sequences.options import InputOptions
from bevcli.workshop.odometry import OdometryOptions, OdometryOutputOptions

PANEL = "Look"


def odometry(
    sequence: InputDrive,
    options: OdometryOptions,
    source: Annotated[InputOptions, Part(only=("frames", "scene", "rate_hz", "every", "allow_outside"))],
    format_options: FormatValues,
    output: OdometryOutputOptions,
    as_json: Json = False,
) -> None:
    """Measure the motion of the vehicle from the images and the calibration of a drive. It needs no poses.

    Prints the length of the way, the mean speed, the deviation of its end, and the steps that could not be measured.
    Writes ego_motion.csv, which can be used as it is in a sequence folder or with --ego-motion; report.json with all
    numbers of each step; odometry.png, the way on the road and the curves of speed and yaw rate; and odometry.rrd,
    the same for `bevcli viz`. A drive with more than 15 frames per second is thinned to 10, unless --rate or --every
    is given. Nothing in SEQUENCE is changed. `bevcli run SEQUENCE --odometry` measures first and then runs a model.
    """
    from bevcli.cli.progress import Progress
    from bevcli.sequences.open import open_sequence
    from bevcli.workshop.odometry.compare import compare
    from bevcli.workshop.odometry.drives import at_most_rate
    from bevcli.workshop.odometry.measure import MeasuredMotion, measure_steps
    from bevcli.workshop.odometry.picture import WatchedDrive, stitched, write_picture
    from bevcli.workshop.odometry.recording import write_recording
    from bevcli.workshop.odometry.report import against_stated, check_measured, report_text, to_json, write_report
    from bevcli.writing import check_output

    reading = replace(source, ego_motion="measured")
    found = open_sequence(sequence, reading, ground_truth=False, **format_options)
    drive = WatchedDrive(found if source.rate_hz or source.every else at_most_rate(found))
    out = output.out or Path("runs") / f"{drive.name}-odometry"
    check_output(out / "ego_motion.csv", sequence / "ego_motion.csv")
    steps = []
    with Progress(len(drive.stamps) - 1, "steps", drive.notes) as progress:
        for step in measure_steps(drive, options):
            steps.append(step)
            progress.advance()
    motion = MeasuredMotion.of(drive, steps)
    check_measured(motion)
    stated = drive.stated_poses
    difference = None if stated is None else against_stated(motion, stated)
    indices = [stamp.index for stamp in drive.stamps]
    findings = () if drive.ego_motion is None else compare(drive.ego_motion, motion, indices)
    written = write_report(motion, out, difference, findings)
    road = stitched(drive, motion.poses)
    write_picture(out / "odometry.png", motion, road, stated)
    write_recording(out / "odometry.rrd", motion, drive, road, stated)
    written += [out / "odometry.png", out / "odometry.rrd"]
    say((to_json if as_json else report_text)(motion, difference, findings))
    say("Written: " + ", ".join(map(str, written)), err=as_json)
