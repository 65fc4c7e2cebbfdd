"""`bevcli project-debug`: find mistakes in a calibration."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from bevcli.cli.input_options import AllowOutsideOption, TopicOption, TopicsOption, complete_model, parse_topics

ERRORS_FOUND = 3


def project_debug(
    calibration: Annotated[
        Path, typer.Argument(help="A calibration.json, a sequence that contains one, or a ROS bag.")
    ],
    sequence: Annotated[
        Path | None, typer.Option(help="A sequence folder whose images and ego-motion belong to the calibration.")
    ] = None,
    frame: Annotated[int, typer.Option(min=0, help="Index of the frame whose images are drawn on.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="The output folder. Default: runs/<name>-project-debug.", show_default=False),
    ] = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    allow_outside: AllowOutsideOption = False,
    model: Annotated[
        str,
        typer.Option(
            autocompletion=complete_model,
            help="Compare the rig with those that this model's weights were trained on: a model name or a FILE.toml.",
        ),
    ] = "demo",
    json: Annotated[
        bool, typer.Option("--json", help="Print the findings and the coverage as one JSON object.")
    ] = False,
) -> None:
    """Find mistakes in a calibration.

    Checks the camera poses and lenses, the bev frame and, with a sequence, its ego-motion and timestamps. Writes
    cameras.png (pillars, ground grid and horizon in each image), coverage.png (how many cameras see each BEV cell),
    recording.rrd (for bevcli viz) and findings.json. Existing files are overwritten.

    Exit code: 0 without errors, 3 with findings of severity error.
    """
    from bevcli.config import load_config
    from bevcli.pipeline.training_rigs import rig_notes
    from bevcli.rig.check_calibration import check_calibration
    from bevcli.rig.report_text import INDENT, WIDTH

    options: dict[str, Any] = {"topics": parse_topics(topic), "topics_file": topics} if topic or topics else {}
    check = check_calibration(calibration, sequence, frame, allow_outside=allow_outside, **options)
    written = check.write(out or Path("runs") / f"{check.name}-project-debug")
    if json:
        print(check.to_json())
    else:
        notes = [
            textwrap.fill(f"Model {model}: {note}.", WIDTH, subsequent_indent=INDENT) + "\n"
            for note in rig_notes(check.rig, load_config(model))
        ]
        print(check.text(), "", *notes, "Written: " + ", ".join(map(str, written)), sep="\n")
    if check.errors:
        raise typer.Exit(ERRORS_FOUND)
