"""A scene in the DGP format, such as one of DDAD, as an input format."""

from bevcli.sequences.format import Format

FOLDERS = ("calibration", "ontology", "rgb")  # a folder with these is a scene that lacks its file

FORMAT = Format(
    name="a DGP scene",
    expected="scene_*.json",
    recognises=lambda path: any(path.glob("scene_*.json")) or all((path / name).is_dir() for name in FOLDERS),
    opener="bevcli.workshop.formats.dgp.sequence:DgpSequence",
    annotated=True,
)
