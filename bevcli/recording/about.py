"""The page "About" of a recording: what was run, and how to read the views."""

from __future__ import annotations

from bevcli import __version__
from bevcli.geometry.cameras import CameraRig
from bevcli.recording.options import RecordingOptions

READING = """\
**Boxes** have their class's colour; the crossed front face, and the line from above, show where they head.
**Ground truth** (`ground_truth`) is pale where the model found it and red where it was missed; a box crossed out in
red has no ground truth of its class within 2 m.
Hidden at first: `pillars`, the 3D reference points and where each camera sees them, blue low and red high.
Click the eye beside an entity in the left panel to show or hide it.
"""


def about_text(title: str, rig: CameraRig, options: RecordingOptions, *, untrained: bool) -> str:
    """The page, in Markdown."""
    warning = "**The weights are untrained: boxes and maps mean nothing.**\n\n" if untrained else ""
    cameras = ", ".join(rig.names)
    facts = f"bevcli {__version__}; {len(rig.cameras)} cameras: {cameras}. Boxes shown from score {options.score:g}.\n"
    return f"# {title}\n\n{warning}{facts}\n{READING}"
