"""Class names of data sets: compared without case, renamed by a class map, counted where they stay unknown."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import read_text


class ClassNames:
    """Maps the class names of a file to known classes.

    A name that differs from a known class only in case becomes that class. Other names stay as they are.

    renames: names of the file (in any case) -> known classes. classes: the known ones. Raises InputError for a target
    that is not known.
    """

    def __init__(
        self, renames: Mapping[str, str] | None = None, classes: Iterable[str] = tuple(NUSCENES_CLASSES)
    ) -> None:
        self.known = tuple(classes)
        self._by_name: dict[str, str] = {name: name for name in self.known}
        self._by_lower_case = {name.lower(): name for name in reversed(self.known)}
        known = dict(self._by_lower_case)
        for name, target in (renames or {}).items():
            if target.lower() not in known:
                raise InputError(
                    f'`class_map` {name}={target}: "{target}" is not a class (expected one of {", ".join(self.known)})'
                )
            exact = target if target in self.known else known[target.lower()]
            self._by_lower_case[name.lower()] = self._by_name[name] = exact

    @staticmethod
    def of_format(table: Mapping[str, str], renames: Mapping[str, str]) -> "ClassNames":
        """The names of a format that has names of its own. table: its names -> nuScenes' classes.

        A name that the user renames keeps its name, so that `renames` finds it.
        """
        renamed = {name.lower() for name in renames}
        return ClassNames({name: one for name, one in table.items() if name.lower() not in renamed})

    def __getitem__(self, name: str) -> str:
        found = self._by_name.get(name)
        if found is None:
            found = self._by_name[name] = self._by_lower_case.get(name.lower(), name)
        return found

    def renamed(self, boxes: Boxes3D) -> Boxes3D:
        """The boxes with the names of known classes."""
        names = {name: self[name] for name in np.unique(boxes.classes).tolist()}
        if all(name == new for name, new in names.items()):
            return boxes
        return replace(boxes, classes=np.array([names[name] for name in boxes.classes.tolist()]))

    def note(self, counts: Mapping[str, int], where: str, use: str = "scored") -> tuple[str, ...]:
        """A note about boxes whose class is not known, if there are any.

        counts: number of boxes by the file's names. where: the file or the side that has them. use: what is not done
        with them.
        """
        others = {name: count for name, count in counts.items() if self[name] not in self.known}
        if not others:
            return ()
        named = ", ".join(f"{name} ({count})" for name, count in sorted(others.items()))
        return (
            f"{where}: {sum(others.values())} boxes have other classes and are not {use}: {named} "
            f'(`class_map` "{min(others)}={self.known[0]}" renames a class)',
        )


def read_class_map(path: Path) -> dict[str, str]:
    """A class map in TOML, one `"Name in the file" = "class"` a line. Raises InputError if it is not one."""
    stated = parse_toml(read_text(path, TOML_BYTES), path)
    for name, target in stated.items():
        if not isinstance(target, str):
            raise InputError(f'{path}: {name}: expected the name of a class, such as "truck", found {target!r:.40}')
    return stated


def count_classes(frames: Iterable[Boxes3D]) -> Counter[str]:
    """Number of boxes by class."""
    return Counter(name for boxes in frames for name in boxes.classes.tolist())
