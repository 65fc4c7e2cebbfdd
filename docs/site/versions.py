"""Write the first page of a site and its list of versions: `python docs/site/versions.py build/site`.

A version is a folder of the site, such as 0.2.0, that `make docs` of that version built.
"""

import re
import sys
from pathlib import Path

PAGE = '<!doctype html>\n<meta charset="utf-8">\n<title>bevcli</title>\n'


def versions(site: Path) -> list[str]:
    """The versions of the site, the newest first."""
    names = [path.parent.name for path in site.glob("*/README.html")]
    numbered = [name for name in names if re.fullmatch(r"\d+(\.\d+)*", name)]
    return sorted(numbered, key=lambda name: [*map(int, name.split("."))], reverse=True)


def write_pages(site: Path) -> None:
    """Write index.html, which leads to the newest version, and versions.html."""
    found = versions(site)
    links = [f'<li><a href="{name}/README.html">bevcli {name}</a>\n' for name in found]
    start = f"{found[0]}/README.html"
    refresh = f'<meta http-equiv="refresh" content="0; url={start}">\n'
    (site / "index.html").write_text(f'{PAGE}{refresh}<a href="{start}">bevcli</a>\n')
    (site / "versions.html").write_text(f"{PAGE}<h1>Versions</h1>\n<ul>\n{''.join(links)}</ul>\n")


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]))
