"""The values of --frames, --rate, --static and --no-temporal as arguments of `open_sequence`."""

import pytest
import typer

from bevcli.cli.input_options import ego_motion_use, parse_frames, parse_rate


@pytest.mark.parametrize(
    ("text", "frames"),
    [(None, [0, 1, 2, 3, 4]), ("1:3", [1, 2]), (":2", [0, 1]), ("3:99", [3, 4]), ("4:", [4]), (":", [0, 1, 2, 3, 4])],
)
def test_frames_range_excludes_its_end(text, frames):
    chosen = parse_frames(text)
    assert [0, 1, 2, 3, 4][slice(None) if chosen is None else chosen] == frames


@pytest.mark.parametrize("text", ["3", "a:b", "-1:2", "1:2:3", ""])
def test_invalid_frames_range_is_a_usage_error(text):
    with pytest.raises(typer.BadParameter, match="expected A:B"):
        parse_frames(text)


def test_rate_is_a_number_or_all():
    assert parse_rate("2.5", default_hz=2.0) == 2.5
    assert parse_rate("all", default_hz=2.0) is None
    assert parse_rate(None, default_hz=2.0) == 2.0


@pytest.mark.parametrize("text", ["fast", "-2", "0", "inf", "nan"])
def test_invalid_rate_is_a_usage_error(text):
    with pytest.raises(typer.BadParameter, match="frames per second"):
        parse_rate(text, default_hz=2.0)


def test_static_takes_precedence_over_no_temporal():
    assert ego_motion_use(static=True, temporal=False) == "static"
    assert ego_motion_use(static=False, temporal=False) == "optional"
    assert ego_motion_use(static=False, temporal=True) == "required"
