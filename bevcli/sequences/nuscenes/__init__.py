"""nuScenes datasets, read without the official devkit (which needs an old NumPy).

sequence: NuScenesDrive, the dataset as a drive, and TableDrive, for formats with the same tables.
index: the contents of tables as arrays, dialects, splits and frames. tables: reads and caches them.
"""

from pathlib import Path

from bevcli.options import option, options
from bevcli.sequences.format import Format


@options("Input")
class NuScenesOptions(Format):
    """A nuScenes root, and the part of it that is read."""

    name = "a nuScenes root"
    expected = "v1.0-*/scene.json"
    reader = "bevcli.sequences.nuscenes.sequence:NuScenesDrive"
    annotated = True
    precedence = 20

    version: str | None = option(
        default=None, help="nuScenes: dataset version, such as v1.0-mini. Default: the only one present."
    )
    split: str | None = option(
        default=None, help="nuScenes: only scenes of this split (train, val, test, mini_train, mini_val)."
    )
    sweeps: bool = option(
        default=False, help="nuScenes: also read the images between keyframes (12 frames per second)."
    )

    @property
    def wants_all_frames(self) -> bool:
        """With sweeps, every frame is kept unless a rate is given."""
        return self.sweeps

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True if a folder contains the tables of a nuScenes version."""
        return is_nuscenes_root(path)


def versions_in(root: Path) -> list[str]:
    """The versions whose tables a folder contains, such as "v1.0-mini" for ROOT/v1.0-mini/scene.json."""
    return sorted(path.parent.name for path in root.glob("v1.*/scene.json"))


def is_nuscenes_root(path: Path) -> bool:
    """True if a folder contains the tables of a nuScenes version."""
    return bool(versions_in(path))
