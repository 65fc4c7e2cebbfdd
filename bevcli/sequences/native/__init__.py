"""The native sequence folder: one drive with calibration, images or videos, ego-motion and ground truth.

folder: FolderDrive, the folder as a drive. unlisted: its frames where it has no frames.csv, from the times that
name_times finds and matching puts together; camera_names: whose folders these are.
"""

from bevcli.sequences.format import Format
from bevcli.sequences.native.camera_names import has_camera_folders
from bevcli.sequences.native.options import FolderOptions

# Any of these makes a folder a native sequence, so that an incomplete one gets an error that names the missing file.
MARKERS = ("calibration.json", "frames.csv", "ego_motion.csv", "images", "videos")

FORMAT = Format(
    name="a sequence folder",
    expected="calibration.json, frames.csv, ego_motion.csv, images or videos",
    recognises=lambda path: any((path / part).exists() for part in MARKERS) or has_camera_folders(path),
    opener="bevcli.sequences.native.folder:FolderDrive",
    options=FolderOptions,
    precedence=-10,
)
