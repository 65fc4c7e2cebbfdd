"""A T4 dataset as a Sequence."""

from pathlib import Path

from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.sequences.files.class_names import ClassNames
from bevcli.sequences.native.folder import rig_notes
from bevcli.sequences.nuscenes.dialect import Dialect
from bevcli.sequences.nuscenes.sequence import TableSequence
from bevcli.sequences.options import FormatOptions, SequenceOptions
from bevcli.sequences.t4.classes import CLASS_OF_CATEGORY

LIDARS = ("LIDAR_CONCAT", "LIDAR_TOP")
# The documented meaning: not occluded, by less than half, by more than half, and by 90 to 100 %.
VISIBILITIES = {"full": 1.0, "most": 0.75, "partial": 0.3, "none": 0.05}


class T4Sequence(TableSequence):
    """The keyframes of a T4 dataset.

    The ego frame is Autoware's base_link: below the rear axle, on the ground. The bev frame is the default, because the
    lidar's axes differ from those of nuScenes' LIDAR_TOP. Raises InputError as `TableSequence`.
    """

    def __init__(
        self, path: Path, common: SequenceOptions = SequenceOptions(), own: FormatOptions = FormatOptions()
    ) -> None:
        names = ClassNames.of_format(CLASS_OF_CATEGORY, common.class_map)
        dialect = Dialect(
            LIDARS, names.__getitem__, VISIBILITIES, has_attributes=False, ego_from_bev=default_ego_from_bev()
        )
        super().__init__(path, path / "annotation", common, dialect)
        self.name = path.resolve().name
        self.notes = (*self.notes, *rig_notes(self.rig, "a T4 dataset"))
