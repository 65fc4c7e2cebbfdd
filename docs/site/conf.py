"""The site of the documents: `make docs` builds it from the pages as they stand, with the API from the docstrings."""

from __future__ import annotations

import importlib
import inspect
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx import addnodes
from sphinx.application import Sphinx

import bevcli

ROOT = Path(__file__).parents[2]
# The sections of the site and their pages, in order. A page that is missing here fails the build.
SECTIONS = {
    "Start": ["self"],
    "Run and look": [
        "docs/commands",
        "docs/own-images",
        "docs/cameras-only",
        "docs/sequence-format",
        "docs/weights",
        "docs/other-inputs",
        "docs/video",
        "docs/odometry",
        "docs/recording",
        "docs/rendered-drives",
    ],
    "Calibrate": ["docs/calibration"],
    "Score": ["docs/scoring", "docs/compare", "docs/robustness", "docs/trust"],
    "Train": ["docs/fine-tune", "docs/training", "docs/model-card"],
    "Deploy": ["docs/deploy", "docs/containers", "docs/speed", "docs/fleet"],
    "Understand": ["docs/architecture", "docs/bevformer", "docs/vad", "docs/glossary"],
    "Python and extensions": ["docs/python", "docs/live", "docs/service", "docs/extend", "docs/reference"],
    "Project": ["CONTRIBUTING", "SECURITY", "docs/hardening", "CHANGELOG"],
}

project = "bevcli"
copyright = "the bevcli authors, Apache-2.0"
version = release = bevcli.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "README"
include_patterns = [f"{root_doc}.md", *(f"{page}.md" for pages in SECTIONS.values() for page in pages), "docs/*.md"]
exclude_patterns = [".*", "bevcli", "build", "runs", "samples", "tests"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # the anchors of GitHub

autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False
napoleon_attr_annotations = False  # the signature has the types
napoleon_custom_sections = [("Attributes", "params_style")]
default_role = "py:obj"
highlight_language = "text"
smartquotes_action = "D"  # dashes only: a quotation mark is code
toc_object_entries_show_parents = "hide"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"bevcli {version}"
html_extra_path = ["index.html"]
templates_path = ["templates"]
# Those of furo, and the link to the list of versions that versions.py writes.
_SCROLLED = ["sidebar/scroll-start.html", "sidebar/navigation.html", "sidebar/scroll-end.html"]
html_sidebars = {"**": ["sidebar/brand.html", "versions.html", "sidebar/search.html", *_SCROLLED]}
html_show_sourcelink = False
html_copy_source = False
html_math_renderer = "mathml"

# A line of docs/reference.md that names an object of the API: the site shows its docstring and signature there.
_ENTRY = re.compile(r"^- `(bevcli[\w.]*)`.*\n(?:  .*\n)*", flags=re.MULTILINE)


def contents() -> str:
    """The pages of the sections for the side bar."""
    return "".join(
        f"\n```{{toctree}}\n:hidden:\n:caption: {section}\n\n" + "".join(f"{page}\n" for page in pages) + "```\n"
        for section, pages in SECTIONS.items()
    )


def complete_page(app: Sphinx, page: str, source: list[str]) -> None:
    """Add the contents to the first page, and the docstrings to the reference."""
    if page == root_doc:
        source[0] += contents()
    if page == "docs/reference":
        source[0] = _ENTRY.sub(lambda found: docstring_of(found[1]), source[0])


def docstring_of(name: str) -> str:
    """The directive that shows signature and docstring of an object of the API."""
    module, _, attribute = name.rpartition(".")
    target = getattr(importlib.import_module(module), attribute)
    kind = "data" if not callable(target) else "class" if inspect.isclass(target) else "function"
    return f"```{{eval-rst}}\n.. auto{kind}:: {name}\n```\n"


def mark_examples(app: Sphinx, kind: str, name: str, target: Any, options: Any, lines: list[str]) -> None:
    """Make an indented paragraph of a docstring a block of code; the docstrings are no reStructuredText."""
    if kind == "data":  # that of the type
        lines.clear()
    text = re.sub(r"(?<=\n)(\w[^\n]*[^:\n])\n\n(    )", r"\1\n\n.. code-block:: python\n\n\2", "\n" + "\n".join(lines))
    text = re.sub(r"(?<=-)\*(?=/)", r"\\*", text)  # a pattern of names is no emphasis
    lines[:] = text.split("\n")[1:]


def shorten_signature(
    app: Sphinx, kind: str, name: str, target: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Write `...` for the default of a field that a function makes: `<factory>` is no Python."""
    return signature and signature.replace("<factory>", "..."), returned


def find_public_name(app: Sphinx, environment: Any, node: Any, content: Any) -> Any:
    """Link a type by its public name: `bevcli.frame.Frame` is documented as `bevcli.Frame`."""
    public = f"bevcli.{node.get('reftarget', '').rpartition('.')[2]}"
    domain = environment.get_domain("py")
    if node.get("refdomain") != "py" or public not in domain.objects:
        return None
    return domain.resolve_xref(environment, node["refdoc"], app.builder, "obj", public, node, content)


def link_source_files(app: Sphinx, tree: nodes.document, page: str) -> None:
    """Link a Python file of the repository to its page of `source_pages`, in place of a download."""
    for node in list(tree.findall(addnodes.download_reference)):
        if not node["reftarget"].endswith(".py"):
            continue
        target = posixpath.normpath(posixpath.join(posixpath.dirname(page), node["reftarget"]))
        uri = app.builder.get_relative_uri(page, f"source/{target}")
        node.replace_self(nodes.reference("", "", *node.children, refuri=uri, internal=True))


def source_pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """The Python files that pages link to, highlighted."""
    for path in map(Path, app.env.dlfiles):
        if path.suffix == ".py":
            code = app.builder.highlighter.highlight_block((ROOT / path).read_text(), "python")
            yield f"source/{path}", {"title": path.name, "body": f"<h1>{path}</h1>{code}"}, "page.html"


def show_math(translator: Any, node: Any) -> None:
    """Write a formula as MathML, which browsers show without a script and without a network."""
    block = isinstance(node, nodes.math_block)
    formula = convert(node.astext(), display="block" if block else "inline")
    translator.body.append(f'<div class="math">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    app.connect("source-read", complete_page)
    app.connect("autodoc-process-docstring", mark_examples, priority=100)  # before napoleon
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("doctree-resolved", link_source_files)
    app.connect("html-collect-pages", source_pages)
    app.connect("missing-reference", find_public_name)
    app.add_html_math_renderer("mathml", inline_renderers=(show_math, None), block_renderers=(show_math, None))
