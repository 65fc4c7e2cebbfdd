"""A T4 dataset of TIER IV as an input format."""

from pathlib import Path

from bevcli.sequences.format import Format


def is_t4_dataset(path: Path) -> bool:
    """True if a folder contains the tables of a T4 dataset."""
    tables = path / "annotation"
    return any((tables / f"{name}.json").exists() for name in ("scene", "sample", "sample_data"))


FORMAT = Format(
    name="a T4 dataset",
    expected="annotation/sample_data.json",
    recognises=is_t4_dataset,
    opener="bevcli.sequences.t4.sequence:T4Sequence",
    annotated=True,
)
