"""A recording in a Jupyter notebook."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import rerun as rr

from bevcli.errors import BevcliError
from bevcli.viewer.recording_file import open_recording

if TYPE_CHECKING:
    from rerun.notebook import Viewer


def show(
    recording: str | Path, *, width: int | Literal["auto"] = "auto", height: int | Literal["auto"] = 720
) -> Viewer:
    """rerun's viewer with a recording, as a widget for a Jupyter notebook: make it the last line of a cell.

        bevcli.show("street.rrd")

    Needs the extra `bevcli[notebook]`.

    Args:
        recording: a recording of `bevcli.Recording` or `bevcli run`.
        width: pixels, or "auto" for the width of the cell.
        height: pixels, or "auto" for 16:9.

    Raises:
        InputError: the file is missing or is not a recording.
        BevcliError: the notebook package of rerun is not installed.
    """
    from rerun.notebook import HAS_NOTEBOOK, Viewer  # needs IPython and costs a second

    if not HAS_NOTEBOOK:
        raise BevcliError("the notebook viewer is not installed: pip install 'bevcli[notebook]'")
    viewer = Viewer(width=width, height=height, use_global_recording=False, theme="dark")
    with open_recording(Path(recording)) as opened:
        stream = rr.RecordingStream("bevcli")
        viewer.add_recording(stream)
        stream.log_file_from_path(opened.path)
        stream.flush(timeout_sec=60.0)
    return viewer
