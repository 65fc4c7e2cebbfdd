"""What calibration.json states about a drive: whether it was rendered, and where it is on Earth."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from memory_drive import MemoryDrive
from typer.testing import CliRunner

from bevcli.cli.main import app
from bevcli.errors import InputError
from bevcli.frame import DriveFacts
from bevcli.geometry.transforms import GeoOrigin
from bevcli.sequences.files.calibration_file import draft_calibration
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.output import NativeWriter

MUNICH = DriveFacts(rendered=True, geo_origin=GeoOrigin(48.1374, 11.5755, 60.0))
SAMPLES = Path(__file__).parents[2] / "samples"


def written(folder: Path, facts: DriveFacts | None) -> Path:
    drive = MemoryDrive(3)
    with NativeWriter(folder, with_ego_motion=True, facts=facts) as writer:
        for place in range(3):
            writer.write(replace(drive.load(place), stamp=replace(drive.stamps[place], scene="")))
    return folder


@pytest.mark.parametrize("facts", [MUNICH, DriveFacts(), DriveFacts(geo_origin=GeoOrigin(-33.9, 151.2))])
def test_what_is_written_is_read(tmp_path, facts):
    assert open_sequence(written(tmp_path / "drive", facts)).facts == facts


def test_a_part_of_a_drive_and_a_converted_drive_state_the_same(tmp_path):
    folder = written(tmp_path / "drive", MUNICH)
    assert open_sequence(folder, frames=slice(0, 2)).facts == MUNICH
    result = CliRunner().invoke(app, ["convert", str(folder), str(tmp_path / "copy")], catch_exceptions=False)
    assert result.exit_code == 0
    assert open_sequence(tmp_path / "copy").facts == MUNICH


def test_a_sequence_of_another_kind_states_nothing():
    assert MemoryDrive(1).facts == DriveFacts()


def test_the_samples_are_rendered():
    assert all(open_sequence(SAMPLES / name).facts.rendered for name in ("street", "crossing"))


def test_the_heading_is_east_where_it_is_missing(tmp_path):
    folder = written(tmp_path / "drive", None)
    change(folder, geo_origin={"latitude": 1.3, "longitude": 103.8})
    assert open_sequence(folder).facts.geo_origin == GeoOrigin(1.3, 103.8, 90.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rendered": "yes"}, '"rendered" is not true or false'),
        ({"geo_origin": [48.1, 11.5]}, '"geo_origin" is not an object'),
        ({"geo_origin": {"latitude": 48.1}}, '"geo_origin.longitude" is missing'),
        ({"geo_origin": {"latitude": 98.1, "longitude": 11.5}}, '"geo_origin.latitude" is out of range'),
        ({"geo_origin": {"latitude": 48.1, "longitude": "east"}}, '"geo_origin.longitude" is not an array of numbers'),
    ],
)
def test_a_mistake_is_one_line_that_names_the_field(tmp_path, changes, message):
    folder = written(tmp_path / "drive", None)
    change(folder, **changes)
    with pytest.raises(InputError) as caught:
        open_sequence(folder)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert draft_calibration(folder / "calibration.json").facts == DriveFacts()


def change(folder: Path, **fields: object) -> None:
    path = folder / "calibration.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))
