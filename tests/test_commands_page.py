"""docs/commands.md, which is generated from the commands."""

import runpy
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
page = runpy.run_path(str(DOCS / "site/commands_page.py"))["page"]


def test_the_page_of_the_commands_is_current():
    assert (DOCS / "commands.md").read_text() == page(), "run `python docs/site/commands_page.py > docs/commands.md`"


def test_the_page_has_every_command_with_its_options():
    text = page()
    assert "\n## bevcli weights convert\n" in text
    assert "| `--rate HZ\\|all` | Thin to this many frames per second. " in text
    assert "| `--temporal`, `--no-temporal` | Use the frames before (and after). [--temporal] |" in text
