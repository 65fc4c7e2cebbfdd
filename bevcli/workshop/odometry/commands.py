"""`bevcli odometry`: measure the motion of the vehicle from the images of a drive."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import FormatValues, InputDrive, Json, Part
from bevcli.cli.progress import Progress, open_with_bar
from bevcli.printing import say
from bevcli.sequences.options import InputOptions
from bevcli.workshop.odometry import OdometryOptions, OdometryOutputOptions
from bevcli.writing import check_output

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
    from bevcli.workshop.odometry import compare, measure, picture, report

    input_options = replace(source, ego_motion="measured")
    opened = open_with_bar(sequence, replace(input_options, ground_truth=False), format_options)
    drive = picture.WatchedDrive(opened if source.rate_hz or source.every else report.at_most_rate(opened))
    out = output.out or Path("runs") / f"{drive.name}-odometry"
    check_output(out / "ego_motion.csv", sequence / "ego_motion.csv")
    with Progress(len(drive.stamps) - 1, "steps", drive.notes) as progress:
        motion = measure.MeasuredMotion.of(drive, progress.over(measure.measure_steps(drive, options)))
    report.check_measured(motion)
    stated_poses = drive.stated_poses
    difference = None if stated_poses is None else report.against_stated(motion, stated_poses)
    indices = [stamp.index for stamp in drive.stamps]
    findings = () if drive.ego_motion is None else compare.compare(drive.ego_motion, motion, indices)
    written = report.write_report(motion, out, difference, findings)
    road = picture.stitched(drive, motion.poses)
    picture.write_picture(out / "odometry.png", motion, road, stated_poses)
    picture.write_recording(out / "odometry.rrd", motion, drive, road, stated_poses)
    written += [out / "odometry.png", out / "odometry.rrd"]
    say((report.to_json if as_json else report.report_text)(motion, difference, findings))
    say("Written: " + ", ".join(map(str, written)), err=as_json)
