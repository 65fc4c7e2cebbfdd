"""`bevcli run`: a sequence in, boxes and a recording out."""

import gc
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bevcli.cli.bridge import FormatValues, InputDrive
from bevcli.cli.progress import Progress, load_with_bar, open_with_bar
from bevcli.cli.stop_signals import StopSignals
from bevcli.inference import PHOTOGRAPHS, ModelOptions
from bevcli.options import Option
from bevcli.printing import say
from bevcli.recording import RecordingOptions
from bevcli.runs import OutputOptions, RunOptions
from bevcli.sequences.format import format_of
from bevcli.sequences.native import holds_videos_alone
from bevcli.sequences.options import InputOptions

if TYPE_CHECKING:
    from bevcli.frame import Drive, Frame, Prediction
    from bevcli.inference.load import Model
    from bevcli.workshop.checks.standing_check import StandingCheck

PANEL = "Run"
FAST = 1.5  # times the rate of the training, from which on a drive gets a note


def run(
    sequence: InputDrive,
    *,
    model: ModelOptions,
    run_options: RunOptions,
    recording: RecordingOptions,
    source: InputOptions,
    calibrate: Annotated[
        bool,
        Option(
            "Measure the calibration of the drive first, as `bevcli calibrate` does, and use the corrected one.",
            "Input",
        ),
    ] = False,
    output: OutputOptions,
    format_options: FormatValues,
) -> None:
    """Run BEVFormer on SEQUENCE, frame by frame, and write boxes and a recording.

    The output folder gets recording.rrd (open it with `bevcli viz`), predictions.json (all boxes of all frames),
    tracks.csv (one row a box with its track), summary.json, for models that predict a map segmentation/, and for a
    drive of one scene calibration.json (the rig). A model that predicts lines of the map or plans a path adds
    map_lines.json and plan.csv, one with a detector image_boxes.csv (one row a box in a camera's image).
    Ctrl-C or SIGTERM finish the current frame; a second one ends the program at once.
    """
    gc.disable()  # a fifth faster: of the million objects of the packages, hardly any is garbage
    from bevcli.runs.run_into_folder import run_in_folder
    from bevcli.workshop.checks.standing_check import StandingCheck

    gc.enable()
    if not gc.get_freeze_count():
        gc.freeze()  # later collections do not look at these objects either
    loaded, why = load_with_bar(model, [sequence])
    may_have_poses = format_of(sequence).has_poses and not holds_videos_alone(sequence)
    if source.ego_motion == "required" and not (
        format_options.get("ego_motion_file") or may_have_poses or source.odometry
    ):
        run_options = replace(run_options, temporal=False)
        why += ("without poses no history is used (`odometry=True` (`--odometry`) measures them from the images)",)
    source = source.for_model(loaded.config, temporal=run_options.temporal)
    drive = open_with_bar(sequence, source, format_options)
    if calibrate:
        from bevcli.workshop.calibration.in_turn import corrected

        drive = corrected(drive)
    loaded = loaded.in_engine(drive.rig, drive, parts="--probe" if recording.probes else "")
    out = output.out or Path("runs") / f"{drive.name}-{loaded.name}"
    live = None
    if output.live:
        from bevcli.viewer.rerun_viewer import LiveView

        live = LiveView()
    standing = StandingCheck() if source.ego_motion == "static" and run_options.temporal else None
    options, path = replace(run_options, recording=recording), shlex.quote(str(sequence))
    files = run_in_folder(loaded, drive, out, options, live=live, force=output.force, resume=output.resume, source=path)
    with StopSignals("frame") as signals, files as running:
        notes = [*why, *running.summary.input_errors, *_run_notes(loaded, drive, run_options, live=output.live)]
        with Progress(len(drive.stamps), "frames", notes) as progress:
            progress.skip(running.done)
            for frame, prediction in running.frames:
                for warning in _frame_warnings(frame, prediction, standing):
                    progress.message(f"warning: {warning}")
                progress.advance()
                if signals.received():
                    break
    summary = running.summary
    say(summary.table())
    if run_options.score_without_labels:
        from bevcli.workshop.trust import estimate

        found = estimate.agreement_of_boxes(out, drive)
        say(replace(found, findings=estimate.find_faults(loaded, drive)).table())
    if signals.received() and not summary.is_complete:
        say(f"stopped; `--resume` goes on with frame {summary.frames + 1} of {len(drive.stamps)}", err=True)
        raise typer.Exit(signals.exit_code)
    say(f"next     bevcli viz {shlex.quote(str(out))}")


def _run_notes(model: "Model", drive: "Drive", options: RunOptions, *, live: bool = False) -> list[str]:
    """Notes on a model and a drive before the run starts. live: whether a viewer follows the run."""
    from bevcli.recording.blueprint import frame_rate_hz

    notes = list(drive.notes)
    if model.untrained:
        notes.append("the weights are UNTRAINED: random weights, the boxes are meaningless")
    notes += [note for note in (model.source, model.engine_note) if note]
    if model.is_exported:
        notes.append("an exported file shows no attention: the recording has no history map, pillars and probes")
    if model.left_out:
        notes.append(f"{model.weights}: left out {model.left_out}, which a run does not need")
    if model.not_read:
        notes.append(f"{model.weights}: objects that were not read, and not run: {', '.join(model.not_read)}")
    rate_hz, trained_hz = frame_rate_hz(drive.stamps), model.config.rate_hz
    if options.temporal and model.config.uses_history and rate_hz > FAST * trained_hz:
        notes.append(
            f"{rate_hz:.3g} frames per second: the model learned its history at {trained_hz:g} "
            f"(`rate_hz={trained_hz:g}` (`--rate {trained_hz:g}`) thins the drive, `temporal=False` (`--no-temporal`) "
            "runs each frame alone)"
        )
    later = model.config.later_frames
    if live and later:
        notes.append(f"model {model.name} looks ahead: the viewer shows a frame when {later} more are read")
    notes += model.training_notes(drive.rig)
    if model.bundled and not drive.facts.rendered:
        learned = f"these weights were trained on rendered streets; `--model {PHOTOGRAPHS}` finds more on photographs"
        if model.name == PHOTOGRAPHS:
            learned = (
                "near cars and people are found as in photographs; barriers, cones, trailers and construction vehicles "
                f"were seen in renderings only; boxes reach {model.config.bev_grid.nearest_side_m:g} m, and a wrong "
                "height of the camera, hills and hidden feet displace them"
            )
        notes.append(f"{learned} (docs/model-card.md)")
    return notes


def _frame_warnings(frame: "Frame", prediction: "Prediction", standing: "StandingCheck | None") -> list[str]:
    """Those of the input, and warnings on results that are not finite, gaps in time and images that move."""
    where, warnings = f"frame {frame.stamp.index}", frame.warnings
    if prediction.failure:
        warnings.append(f"{where}: {prediction.failure}")
    if prediction.started_anew and prediction.started_anew.reason.name == "GAP":
        warnings.append(f"{where}: no history: {prediction.started_anew}")
    if standing is not None and prediction.started_anew is None and standing.images_move(frame):
        warnings.append(f"{where}: {standing.note}")
    return warnings
