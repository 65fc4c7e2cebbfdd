"""`bevcli project-debug`: find mistakes in a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.input_options import TopicOption, TopicsOption, parse_topics

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
    from bevcli.rig.check_calibration import check_calibration

    options = {} if not (topic or topics) else {"topics": parse_topics(topic), "topics_file": topics}
    check = check_calibration(calibration, sequence, frame, **options)
    written = check.write(out or Path("runs") / f"{check.name}-project-debug")
    if json:
        print(check.to_json())
    else:
        print(check.text(), "", "Written: " + ", ".join(map(str, written)), sep="\n")
    if check.errors:
        raise typer.Exit(ERRORS_FOUND)
