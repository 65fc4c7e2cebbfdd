"""True lines of the map in drives that are written: kept by sequence folders, and named where they are left out."""

from dataclasses import replace

import numpy as np
import pytest
from memory_drive import MemoryDrive

from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats import WriteOptions
from bevcli.workshop.formats.convert import open_writer, truth_left_out
from bevcli.workshop.formats.map_lines import MapLines

LINE = np.array([[1.0, 2.0], [3.0, 14.0]])


def with_lines(drive: MemoryDrive, index: int):
    return replace(drive.load(index), ground_truth_results=(MapLines((LINE,), np.array(["divider"])),))


def test_a_sequence_folder_keeps_the_lines_of_each_frame(tmp_path):
    drive = MemoryDrive(2)
    for source, target in ((None, "one"), ("one", "two")):
        read = None if source is None else open_sequence(tmp_path / source)
        with open_writer(tmp_path / target, drive, WriteOptions()) as writer:
            for place in range(2):
                writer.write(with_lines(drive, place) if read is None else read.load(place))
    read = open_sequence(tmp_path / "two")
    for place in range(2):
        (lines,) = read.load(place).ground_truth_results
        assert list(lines.classes) == ["divider"]
        np.testing.assert_allclose(lines.points[0], LINE, atol=0.005)


@pytest.mark.parametrize(("form", "expected"), [("native", set()), ("nuscenes", {"lines of the map"})])
def test_a_format_names_the_truth_that_it_leaves_out(form, expected):
    assert truth_left_out(with_lines(MemoryDrive(1), 0), form) == expected
