"""YAML and XML with the limits of `bevcli.parsing.documents`: no objects that contain themselves, no entities."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import yaml

from bevcli.errors import InputError
from bevcli.parsing.documents import DEEPEST, check_values
from bevcli.parsing.files import MIB, read_text
from bevcli.printing import reason_of

YAML_BYTES = MIB // 4
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _YamlLoader(_SafeLoader):
    """The safe loader, which makes no Python objects, and reads OpenCV's matrices as mappings."""


_YamlLoader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)


def read_yaml(path: Path) -> Any:
    """The contents of a YAML file with plain values. Raises InputError."""
    text = re.sub(r"\A%YAML:.*", "", read_text(path, YAML_BYTES))  # OpenCV's header, which is not YAML
    try:
        depth = 0
        for event in yaml.parse(text, _YamlLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST:
                raise InputError(f"{path}: is nested too deeply (expected at most {DEEPEST} levels)")
        document = yaml.load(text, _YamlLoader)
    except yaml.YAMLError as error:
        raise InputError(f"{path}: broken YAML ({reason_of(error)[:200]})") from None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f"{path}: cannot be read as YAML ({reason_of(error)[:200]})") from None
    check_values(document, path)
    return document


def parse_xml(text: bytes, path: Path) -> ElementTree.Element:
    """The root of an XML document without entities of its own. Raises InputError, which names `path`.

    A few short entities can stand for gigabytes of text. None is read from another file.
    """

    def refuse(name: str, *declaration: object) -> None:
        raise InputError(f"{path}: declares the entity {name:.40} (expected XML without entities)")

    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler, parser.EntityDeclHandler = builder.data, refuse
    parser.buffer_text = True
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise InputError(f"{path}: broken XML: {reason_of(error)[:200]}") from None
