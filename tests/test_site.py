"""The site of the documents (`make docs`): its versions and its reference; a missing page or link fails its build."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from runpy import run_path
from urllib.parse import unquote

import bevcli

ROOT = Path(__file__).parents[1]
write_pages = run_path(str(ROOT / "docs/site/versions.py"))["write_pages"]


def test_the_first_page_leads_to_the_newest_version(tmp_path):
    for name in ("0.9.1", "0.10.0", "0.2.0", "doctrees"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "README.html").touch()
    write_pages(tmp_path)
    assert Links(tmp_path / "index.html").links == ["0.10.0/README.html"]
    assert Links(tmp_path / "versions.html").links == [f"{name}/README.html" for name in ("0.10.0", "0.9.1", "0.2.0")]


def test_reference_names_every_public_name():
    named = re.findall(r"^- `bevcli\.(\w+)`: \S", (ROOT / "docs/reference.md").read_text(), flags=re.MULTILINE)
    assert sorted(named) == sorted(set(named))
    assert set(named) == set(bevcli.__all__)


class Links(HTMLParser):
    """Links and anchors of a page."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(page.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.anchors |= {given.get("id") or "", given.get("name") or ""}
        link = given.get("href" if tag in ("a", "link") else "src")
        if link and not re.match(r"\w+:|//", link):
            self.links.append(unquote(link))
