"""A scene in the DGP format, such as one of DDAD, as an input format."""

from pathlib import Path

from bevcli.sequences.format import Format


def is_dgp_scene(path: Path) -> bool:
    """True if a folder contains the file of a DGP scene, or all but that."""
    return any(path.glob("scene_*.json")) or all((path / part).is_dir() for part in ("calibration", "ontology", "rgb"))


FORMAT = Format(
    name="a DGP scene",
    expected="scene_*.json",
    recognises=is_dgp_scene,
    opener="bevcli.sequences.dgp.sequence:DgpSequence",
    annotated=True,
)
