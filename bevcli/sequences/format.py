"""Format: an input format, of the group "bevcli.sequences" of the registry."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final

from bevcli.errors import BevcliError, InputError
from bevcli.options import defaults, named
from bevcli.registry import entries, load
from bevcli.sequences.options import FormatOptions, InputOptions

if TYPE_CHECKING:
    from bevcli.frame import Drive, Frame, FrameResult

TrueResult = Callable[["Frame"], "FrameResult | None"]  # of a frame with its pose, in its bev frame
GROUP: Final = "bevcli.sequences"
ROOT_DEPTH = 2  # levels of folders between a data set's root and its drives, such as ROOT/val/LOG
FEW = 4  # names in a message


@dataclass(frozen=True)
class Format:
    """An input format.

    Attributes:
        name: with an article, for messages: "a nuScenes root".
        expected: the files that it is recognised by, for messages: "v1.0-*/scene.json".
        recognises: whether a path that exists has this format. Looks at names, or at a few bytes.
        opener: opens a path with the common options and its own, or the name of what does, "module:attribute", which is
            imported when it is needed. `open_sequence` itself selects the scene and the frames, and takes away the
            ground truth. Raises InputError.
        options: the dataclass of its own options.
        annotated: whether its drives may have ground truth that opening them reads, so that `bevcli eval` takes them.
        has_poses: whether its drives may have poses; without them, `bevcli run` uses no history.
        precedence: the format with the highest one is taken where several recognise a path. A format that needs little
            to recognise a path has a low one.
    """

    name: str
    expected: str
    recognises: Callable[[Path], bool]
    opener: str | Callable[[Path, InputOptions, Any], Drive]
    options: type[FormatOptions] = FormatOptions
    annotated: bool = False
    has_poses: bool = True
    precedence: int = 0

    def open(self, path: Path, common: InputOptions, own: FormatOptions) -> Drive:
        """A path of this format as a drive. Raises InputError."""
        opener = resolve_name(self.opener) if isinstance(self.opener, str) else self.opener
        return opener(path, common, own)


def formats(broken: list[BevcliError] | None = None) -> tuple[Format, ...]:
    """All formats, in the order of their registered names.

    Those that cannot be imported are left out, as a package of somebody else may be broken. broken: gets their errors.
    """
    loaded: list[Format] = []
    for name in entries(GROUP):
        try:
            loaded.append(load(GROUP, name))
        except BevcliError as error:
            if broken is not None:
                broken.append(error)
    return tuple(loaded)


def option_classes() -> list[type[FormatOptions]]:
    """The dataclasses of the formats' own options."""
    return [form.options for form in formats()]


def format_of(path: Path) -> Format:
    """The format of a path. Raises InputError if it is missing, or is no drive, or has two formats."""
    broken: list[BevcliError] = []
    known = sorted(formats(broken), key=lambda form: form.precedence)  # in messages, the most general one comes first
    if not path.exists():
        raise InputError(f"{path}: is missing (expected {_either([form.name for form in known])})")
    matching = [form for form in known if form.recognises(path)]
    if not matching:
        drives = list(drives_in(path))
        if drives:
            few = ", ".join(drives[:FEW]) + (", …" if len(drives) > FEW else "")
            raise InputError(
                f"{path}: is a folder of {len(drives)} drives ({few}): choose one with `scene` (`--scene`), or run all "
                "by `bevcli batch`"
            )
        kind = "is a file, and not" if path.is_file() else "is not"
        expected = _either([f"{form.name} (expected {form.expected})" for form in known])
        raise InputError("; ".join([f"{path}: {kind} {expected}", *map(str, broken)]))
    highest = max(form.precedence for form in matching)
    first, *others = [form for form in matching if form.precedence == highest]
    if others:
        raise InputError(f"{path}: is {first.name} and {others[0].name}: keep the files of one format there")
    return first


def is_drive(path: Path) -> bool:
    """True for a path that a format recognises."""
    return any(form.recognises(path) for form in formats())


def drives_in(root: Path) -> dict[str, Path]:
    """The drives below a folder that is no drive itself, such as the root of a data set, by name.

    The name of a drive is that of its folder or file; with the folders above it where two have the same.
    """
    known = formats()
    drives = {path.relative_to(root).as_posix(): path for path in _drives_below(root, known, ROOT_DEPTH)}
    names = Counter(path.name for path in drives.values())
    return {name if names[path.name] > 1 else path.name: path for name, path in drives.items()}


def _drives_below(folder: Path, known: Iterable[Format], depth: int) -> Iterator[Path]:
    if not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        with suppress(OSError):  # a folder that this user may not read holds no drive of theirs
            if any(form.recognises(path) for form in known):
                yield path
            elif depth > 1:
                yield from _drives_below(path, known, depth - 1)


def check_options(values: Mapping[str, Any], chosen: Iterable[Format], where: str) -> None:
    """Check that formats have the options that are given. Values that are the default are accepted for every format.

    where: start of a message. Raises InputError for an option that only other formats have; TypeError for one that no
    format has, or BevcliError if a format cannot be imported that may have it.
    """
    own = {name for form in chosen for name in defaults(form.options)}
    for name in (name for name in values if name not in own):
        broken: list[BevcliError] = []
        having = [form for form in formats(broken) if name in defaults(form.options)]
        if not having:
            raise broken[0] if broken else TypeError(f"open_sequence() has no option `{name}`")
        if values[name] != defaults(having[0].options)[name]:
            option = named(having[0].options, name)
            raise InputError(f"{where}: {option} is for {_either([form.name for form in having])}: remove it")


def _either(names: list[str]) -> str:
    return " or ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
