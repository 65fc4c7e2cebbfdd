"""The short commands of the core: `bevcli samples`, `viz` and `project-debug`."""

import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

import bevcli
from bevcli.cli.bridge import FormatValues, Json, Part, argument
from bevcli.cli.progress import opening
from bevcli.errors import InputError
from bevcli.options import Option, defaults, named
from bevcli.printing import say
from bevcli.recording import RecordingOptions
from bevcli.rig import CheckOptions
from bevcli.sequences.format import formats
from bevcli.sequences.options import InputOptions, RigOptions
from bevcli.viewer import ViewOptions
from bevcli.writing import output_errors, write_whole

PANEL = {"samples": "Start", "viz": "Look", "project-debug": "Look"}
ERRORS_FOUND = 3  # exit code of `bevcli project-debug`


def samples(
    out: Annotated[Path, Option("The folder that gets the sample.", metavar="DIR")] = Path("samples"),
) -> None:
    """Copy the sample drive, a rendered street, to DIR/street, and the notebook first_steps.ipynb.

    The drive is a complete sequence folder. What exists in DIR is left as it is.
    """
    package = Path(__file__).parents[1]
    installed = package / "samples"
    # An editable installation has the samples beside the package.
    source = installed if installed.is_dir() else package.parent / "samples"
    for name, advice in (
        ("street", f"run `bevcli run {out / 'street'}`"),
        ("first_steps.ipynb", "needs pip install 'bevcli[notebook]'"),
    ):
        target = out / name
        if target.exists():
            say(f"{target}: exists already")
            continue
        with output_errors(target):
            if (source / name).is_dir():
                shutil.copytree(source / name, target)
            else:
                write_whole(target, (source / name).read_bytes())
        say(f"{target}: copied; {advice}")


def viz(
    shown: Annotated[
        Path,
        argument(
            "A recording (.rrd), the output folder of `bevcli run`, or a drive, as `bevcli run` takes it.",
            metavar="RECORDING|DRIVE",
        ),
    ],
    options: ViewOptions,
    recording: Annotated[RecordingOptions, Part(only=("score",))],
    source: InputOptions,
    format_options: FormatValues,
) -> None:
    """Show a recording, or a drive with labels and boxes of any model; or write an image, a video or a summary.

    The viewer opens if none of --summary, --screenshot, --video and --out is given: in a window if there is a
    display, else in the browser at an address that only this machine can reach. Ctrl-C closes it.

    A drive needs no model: its labels are shown, or with --boxes those against boxes of one or two models. The input
    options and --score are for a drive.
    """
    from bevcli.cli import viewing

    if options.frame is not None and options.screenshot is None and (options.summary or options.video or options.out):
        raise typer.BadParameter("is only valid with --screenshot, or for the viewer", param_hint="--frame")
    if options.view != "all" and options.video is None:
        raise typer.BadParameter("is only valid with --video", param_hint="--view")
    if not viewing.is_recording(shown):
        viewing.record_drive(shown, options, recording, source, format_options)
        return
    kinds = (ViewOptions, RecordingOptions, InputOptions, *formats())
    usual = {name: (cls, value) for cls in kinds for name, value in defaults(cls).items()}
    for_drives = {
        "boxes": options.boxes,
        "out": options.out,
        "score": recording.score,
        **vars(source),
        **format_options,
    }
    if changed := [name for name, value in for_drives.items() if value != usual[name][1]]:
        option = named(usual[changed[0]][0], changed[0])
        raise InputError(f"{shown}: is a recording, and {option} is for a drive: remove it, or pass the drive")
    viewing.show(viewing.recording_in(shown), options)


def project_debug(
    input: Annotated[
        Path, argument("A drive, such as a sequence folder, a ROS bag or a video, or a calibration alone.")
    ],
    source: Annotated[InputOptions, Part(only=("allow_outside",))],
    format_options: Annotated[
        FormatValues,
        Part(only=(*defaults(RigOptions), "topics", "topics_file", "times", "image_rate_hz", "start_ns")),
    ],
    options: CheckOptions,
    as_json: Json = False,
) -> None:
    """Find mistakes in a calibration.

    Checks the camera poses and lenses, the bev frame and, with a sequence, its ego-motion, its timestamps, and whether
    the images fit how the vehicle moves (short forms of `bevcli odometry` and `bevcli calibrate`). Writes
    cameras.png (pillars, ground grid and horizon in each image), coverage.png (how many cameras see each BEV cell),
    recording.rrd (for bevcli viz) and findings.json. Existing files are overwritten.

    After the findings, the rig is compared with those that the weights of --model were trained on.

    Exit code: 0 without errors, 3 with findings of severity error.
    """
    from bevcli.inference.load import default_model
    from bevcli.rig.check_calibration import model_notes
    from bevcli.sequences.files.calibration_file import CALIBRATION

    drive_options = {name: value for name, value in format_options.items() if value not in (None, {})}
    if options.sequence is not None and "calibration" in drive_options:
        raise InputError("--calibration and --sequence exclude each other: pass the drive, and its --calibration")
    with opening(options.sequence or input):
        check = bevcli.check_calibration(
            input, options.sequence, options.frame, allow_outside=source.allow_outside, **drive_options
        )
    if options.motion and not check.errors:
        from bevcli.workshop.calibration.in_turn import check_motion

        if options.sequence is not None:
            drive_options["calibration"] = input
        how = {"ground_truth": False, "allow_outside": source.allow_outside, **drive_options}
        check = check.with_findings(check_motion(_drive_of(options.sequence or input, **how)))
    folder = options.out or Path("runs") / f"{check.name}-project-debug"
    written = check.write(folder)
    if as_json:
        say(check.to_json())
    else:
        drive = options.sequence or input
        drive = drive.parent if drive.name == CALIBRATION else drive
        notes = model_notes(check.rig, options.model or default_model([drive]))
        say(check.text(), "", *notes, "Written: " + ", ".join(map(str, written)))
    if check.errors:
        raise typer.Exit(ERRORS_FOUND)


def _drive_of(path: Path, **options: Any) -> "bevcli.Drive | None":
    """The drive in a path; None of a calibration alone, or of a drive with errors, which the check reports."""
    try:
        return bevcli.open_sequence(path, **options)
    except InputError:
        return None
