"""A T4 dataset of TIER IV as an input format."""

from bevcli.sequences.format import Format

TABLES = ("scene", "sample", "sample_data")  # any of them makes a folder a T4 dataset

FORMAT = Format(
    name="a T4 dataset",
    expected="annotation/sample_data.json",
    recognises=lambda path: any((path / "annotation" / f"{name}.json").exists() for name in TABLES),
    opener="bevcli.workshop.formats.t4.sequence:T4Sequence",
    annotated=True,
)
