"""docs/commands.md, which is generated from the commands."""

from pathlib import Path

from bevcli.cli.commands_page import page

PAGE = Path(__file__).parents[2] / "docs/commands.md"


def test_the_page_of_the_commands_is_current():
    assert PAGE.read_text() == page(), "run `python -m bevcli.cli.commands_page > docs/commands.md`"


def test_the_page_has_every_command_with_its_options():
    text = page()
    assert "\n## bevcli weights convert\n" in text
    assert "| `--rate HZ\\|all` | Thin to this many frames per second. " in text
    assert "| `--temporal`, `--no-temporal` | Use the frames before (and after). [--temporal] |" in text
