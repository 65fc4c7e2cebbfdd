"""A scene in the DGP format of Toyota Research Institute, such as one of DDAD, as an input format."""

from bevcli.sequences.format import Format

FOLDERS = ("calibration", "ontology", "rgb")  # a folder with these is a scene that lacks its file
# DDAD's class names; docs/other-inputs.md says what is lost. Names are compared without case; others, such as Wheeled
# Slow and Train, stay as they are, and are not scored.
CLASS_OF_CATEGORY = {
    "Person": "pedestrian",
    "Pedestrian": "pedestrian",
    "Bus/RV/Caravan": "bus",
    "Towed Object": "trailer",
    "Caravan/RV": "truck",
}


FORMAT = Format(
    name="a DGP scene",
    expected="scene_*.json",
    recognises=lambda path: any(path.glob("scene_*.json")) or all((path / name).is_dir() for name in FOLDERS),
    opener="bevcli.workshop.formats.dgp_scene:open_scene",
    annotated=True,
)
