"""Metadata of the distributions that depend on the owner of the repository: addresses, and the page of the index."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

# A link or an image of Markdown, up to a target that is a path in the repository or a heading of the page.
RELATIVE = re.compile(r"(!?)(\[[^\]]*\]\()(?![\w+.-]+:)([^)\s]+)")


class RepositoryMetadata(MetadataHookInterface):
    """Fills `urls` and `readme` from `owner` and `urls` of [tool.hatch.metadata.hooks.custom] in pyproject.toml."""

    def update(self, metadata: dict[str, Any]) -> None:
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        address, tag = f"https://github.com/{self.config['owner']}/bevcli", f"v{metadata['version']}"
        metadata["urls"] = {name: url.format(owner=self.config["owner"]) for name, url in self.config["urls"].items()}
        metadata["readme"] = {"content-type": "text/markdown", "text": with_addresses(text, address, tag)}


def with_addresses(text: str, repository: str, tag: str) -> str:
    """The text with addresses in place of paths, those of images with the bytes of the file; an index has neither."""

    def absolute(link: re.Match[str]) -> str:
        image, opening, target = link.groups()
        path = f"README.md{target}" if target.startswith("#") else target
        return f"{image}{opening}{repository}/{'raw' if image else 'blob'}/{tag}/{path}"

    return RELATIVE.sub(absolute, text)
