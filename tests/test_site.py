"""The site of the documents (`make docs`): it has every page and every public name, and its search finds them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from runpy import run_path
from urllib.parse import unquote

import pytest

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


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx")
    pytest.importorskip("furo")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--quiet", "-c", "docs/site"]
    done = subprocess.run(
        [*build, "-d", folder / "doctrees", "-b", "html", ".", folder / "html" / bevcli.__version__],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    shutil.rmtree(folder / "doctrees")
    write_pages(folder / "html")
    return folder / "html" / bevcli.__version__


@pytest.mark.slow
def test_site_has_every_document(site):
    for document in [*ROOT.glob("docs/*.md"), *ROOT.glob("*.md")]:
        assert site.joinpath(document.relative_to(ROOT)).with_suffix(".html").is_file(), document


@pytest.mark.slow
def test_links_of_the_site_lead_to_pages(site):
    pages = {page: Links(page) for page in site.parent.rglob("*.html")}
    assert len(pages) > 20
    for page, found in pages.items():
        for link in found.links:
            path, _, anchor = link.partition("#")
            target = (page.parent / path.partition("?")[0]).resolve() if path else page
            assert target.exists(), f"{page.name}: {link}"
            assert not anchor or target not in pages or anchor in pages[target].anchors, f"{page.name}: {link}"


@pytest.mark.slow
def test_search_finds_terms_and_names(site):
    index = (site / "searchindex.js").read_text()
    for stem in ("quaternion", "amota", "openvino", "cosin"):
        assert re.search(rf'[{{,"]{stem}"?:', index), stem
    for name in bevcli.__all__:
        assert f'"{name}"' in index, name


@pytest.mark.slow
def test_formulas_are_mathml(site):
    assert (site / "docs/bevformer.html").read_text().count("<math") > 50


@pytest.mark.slow
def test_pages_load_nothing_from_elsewhere(site):
    for page in site.rglob("*.html"):
        assert not re.search(r'<(?:script|link|img)[^>]+(?:src|href)="(?:https?:)?//', page.read_text()), page
