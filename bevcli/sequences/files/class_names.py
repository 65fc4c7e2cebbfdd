"""Class names of other data sets: compared without case, renamed by a class map, counted where they stay unknown."""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import CLASSES, Boxes3D
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import read_text

_KNOWN = {name: name for name in CLASSES}


class ClassNames:
    """Maps the class names of a file to the names used here.

    A name that differs from a known class only in case becomes that class. Other names stay as they are.

    renames: names of the file (in any case) -> known classes. Raises InputError for a target that is not known.
    """

    def __init__(self, renames: Mapping[str, str] | None = None) -> None:
        self._by_lower_case = dict(_KNOWN)
        self._by_name: dict[str, str] = dict(_KNOWN)
        for name, target in (renames or {}).items():
            known = _KNOWN.get(target.lower())
            if known is None:
                raise InputError(
                    f'`class_map` {name}={target}: "{target}" is not a class (expected one of {", ".join(CLASSES)})'
                )
            self._by_lower_case[name.lower()] = known
            self._by_name[name] = known

    def __getitem__(self, name: str) -> str:
        found = self._by_name.get(name)
        if found is None:
            found = self._by_name[name] = self._by_lower_case.get(name.lower(), name)
        return found


def read_class_map(path: Path) -> dict[str, str]:
    """A class map in TOML, one `"Name in the file" = "class"` a line. Raises InputError if it is not one."""
    stated = parse_toml(read_text(path, TOML_BYTES), path)
    for name, target in stated.items():
        if not isinstance(target, str):
            raise InputError(f'{path}: {name}: expected the name of a class, such as "truck", found {target!r:.40}')
    return stated


def count_other_classes(frames: Iterable[Boxes3D]) -> Counter[str]:
    """Number of boxes by class, for classes that are not among the ten that are scored."""
    counts: Counter[str] = Counter()
    for boxes in frames:
        counts.update(boxes.classes[~np.isin(boxes.classes, CLASSES)].tolist())
    return counts


def other_classes_note(counts: Mapping[str, int], where: str) -> str:
    """A note for the user about boxes whose class is not scored. where: the file or the side that has them."""
    named = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
    example = next(iter(sorted(counts)))
    return (
        f"{where}: {sum(counts.values())} boxes have other classes and are not scored: {named} "
        f'(`class_map` "{example}=car" renames a class)'
    )
