"""YAML and XML with the limits of `bevcli.parsing.documents`: no objects that contain themselves, no entities."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from bevcli.errors import InputError
from bevcli.parsing.documents import DEEPEST, MOST_VALUES, check_values, first_twice
from bevcli.parsing.files import MIB, read_text
from bevcli.printing import reason_of

YAML_BYTES = MIB // 4
MERGE_TAG = "tag:yaml.org,2002:merge"
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _YamlLoader(_SafeLoader):
    """The safe loader, which makes no Python objects, and reads OpenCV's matrices as mappings.

    Numbers are those of JSON and YAML 1.2: 1e-05 is one, and 010, 12:30 and 1_0, which YAML 1.1 reads as 8, 750 and 10,
    are texts, as "no" and dates are. A key twice in a mapping is an error, and so are more values than a file may have,
    merges written out.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._merged = 0  # values, each counted as often as a merge brings it
        self._seen = set[int]()  # mappings, whose merges are written out in their nodes

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Write out the merges of a mapping, each of which comes here first."""
        if id(node) not in self._seen:
            self._seen.add(id(node))
            keys = [key for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.tag != MERGE_TAG]
            values = [self.construct_object(key) for key in keys]
            twice = first_twice(values)
            twice = first_twice([*map(str, values)]) if twice is None else twice  # 1 and "1" name one camera
            if twice is not None:
                where, name = f"line {keys[twice].start_mark.line + 1}", keys[twice].value
                raise InputError(f'{where}: "{name:.60}" appears twice in the same mapping: remove or rename one')
        super().flatten_mapping(node)
        self._merged += len(node.value)
        if self._merged > MOST_VALUES:
            raise InputError(f"has more than {MOST_VALUES} values, merges written out")


_YamlLoader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)
SCALARS = {  # tag -> its texts, and how they begin
    "int": (r"[-+]?(?:0|[1-9][0-9]*|0x[0-9a-fA-F]+)\Z", "-+0123456789"),
    "float": (
        r"[-+]?(?:\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))(?:[eE][-+]?[0-9]+)?\Z|[-+]?\.(?:inf|nan)\Z",
        "-+.0123456789",
    ),
    "bool": (r"(?:true|True|TRUE|false|False|FALSE)\Z", "tTfF"),
    "null": (r"(?:~|null|Null|NULL|)\Z", ("~", "n", "N", "")),
    "merge": (r"<<\Z", "<"),
}
_YamlLoader.yaml_implicit_resolvers = {}
for tag, (pattern, firsts) in SCALARS.items():
    _YamlLoader.add_implicit_resolver(f"tag:yaml.org,2002:{tag}", re.compile(pattern), list(firsts))


def read_yaml(path: Path) -> Any:
    """The contents of a YAML file with plain values. Raises InputError."""
    text = re.sub(r"\A%YAML:.*", "", read_text(path, YAML_BYTES))  # OpenCV's header, which is not YAML
    try:
        depth = 0
        for event in yaml.parse(text, _YamlLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST:
                raise InputError(f"is nested too deeply (expected at most {DEEPEST} levels)")
        document = yaml.load(text, _YamlLoader)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
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
    if b"<!ENTITY" in text.replace(b"\0", b""):  # of UTF-16
        raise InputError(f"{path}: declares an entity (expected XML without entities)")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path}: broken XML: {reason_of(error)[:200]}") from None
    level = [root]
    for _ in range(DEEPEST):
        level = [child for element in level for child in element]
    if level:
        raise InputError(f"{path}: is nested too deeply (expected at most {DEEPEST} levels)")
    return root
