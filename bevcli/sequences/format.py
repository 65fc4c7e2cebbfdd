"""Format: an input format, of the group "bevcli.sequences" of the registry."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar, Final

from bevcli.errors import BevcliError, InputError
from bevcli.options import defaults, named, options
from bevcli.registry import entries, load
from bevcli.sequences.options import InputOptions

if TYPE_CHECKING:
    from bevcli.frame import Drive, Frame, FrameResult

TrueResult = Callable[["Frame"], "FrameResult | None"]  # of a frame with its pose, in its bev frame
GROUP: Final = "bevcli.sequences"
ROOT_DEPTH = 2  # levels of folders between a data set's root and its drives, such as ROOT/val/LOG
FEW = 4  # names in a message


@options("Input")
class Format:
    """An input format: a dataclass of its own options, which says how a path is recognised, and opens it with them.

    Each class states:

    - name: with an article, for messages: "a nuScenes root".
    - expected: the files that it is recognised by, for messages: "v1.0-mini/scene.json".
    - reader: name of what opens a path, "module:attribute", which is imported when it is needed; see `open`.
    - annotated: whether its drives may have ground truth that opening them reads, so that `bevcli eval` takes them.
    - has_poses: whether its drives may have poses; without them, `bevcli run` uses no history.
    - precedence: the format with the highest one is taken where several recognise a path. A format that needs little to
      recognise a path has a low one.
    """

    name: ClassVar[str]
    expected: ClassVar[str]
    reader: ClassVar[str]
    annotated: ClassVar[bool] = False
    has_poses: ClassVar[bool] = True
    precedence: ClassVar[int] = 0

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a path that exists and has this format. Looks at names, or at a few bytes."""
        raise NotImplementedError

    def open(self, path: Path, common: InputOptions) -> Drive:
        """A path of this format as a drive: its `reader`, called with the path, the common options and these.

        `open_sequence` itself selects the scene and the frames, and takes away the ground truth. Raises InputError.
        """
        drive: Drive = resolve_name(self.reader)(path, common, self)
        return drive

    @property
    def wants_all_frames(self) -> bool:
        """True where an option asks for frames that thinning to a model's rate would drop."""
        return False


def formats(broken: list[BevcliError] | None = None) -> tuple[type[Format], ...]:
    """All formats, in the order of their registered names.

    Those that cannot be imported are left out, as a package of somebody else may be broken. broken: gets their errors.
    """
    loaded: list[type[Format]] = []
    for name in entries(GROUP):
        try:
            loaded.append(load(GROUP, name))
        except BevcliError as error:
            if broken is not None:
                broken.append(error)
    return tuple(loaded)


def format_of(path: Path) -> type[Format]:
    """The format of a path. Raises InputError if it is missing, or is no drive, or has two formats."""
    broken: list[BevcliError] = []
    # In messages, the most general one comes first.
    candidates = sorted(formats(broken), key=lambda form: form.precedence)
    if not path.exists():
        raise InputError(f"{path}: is missing (expected {_either([form.name for form in candidates])})")
    matching = [form for form in candidates if form.recognises(path)]
    if not matching:
        drives = list(drives_in(path))
        if drives:
            few = ", ".join(drives[:FEW]) + (", …" if len(drives) > FEW else "")
            raise InputError(
                f"{path}: is a folder of {len(drives)} drives ({few}): choose one with `scene` (`--scene`), or run all "
                "by `bevcli batch`"
            )
        problem = "is a file, and not" if path.is_file() else "is not"
        expected = _either([f"{form.name} (expected {form.expected})" for form in candidates])
        raise InputError("; ".join([f"{path}: {problem} {expected}", *map(str, broken)]))
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
    drives = {path.relative_to(root).as_posix(): path for path in _drives_below(root, formats(), ROOT_DEPTH)}
    names = Counter(path.name for path in drives.values())
    return {name if names[path.name] > 1 else path.name: path for name, path in drives.items()}


def _drives_below(folder: Path, formats: Iterable[type[Format]], depth: int) -> Iterator[Path]:
    if not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        with suppress(OSError):  # a folder that this user may not read holds no drive of theirs
            if any(form.recognises(path) for form in formats):
                yield path
            elif depth > 1:
                yield from _drives_below(path, formats, depth - 1)


def check_options(values: Mapping[str, Any], classes: Iterable[type[Format]], location: str) -> None:
    """Check that formats have the options that are given. Values that are the default are accepted for every format.

    where: start of a message. Raises InputError for an option that only other formats have; TypeError for one that no
    format has, or BevcliError if a format cannot be imported that may have it.
    """
    option_names = {name for form in classes for name in defaults(form)}
    for name in (name for name in values if name not in option_names):
        broken: list[BevcliError] = []
        having = [form for form in formats(broken) if name in defaults(form)]
        if not having:
            raise broken[0] if broken else TypeError(f"open_sequence() has no option `{name}`")
        if values[name] != defaults(having[0])[name]:
            option = named(having[0], name)
            raise InputError(f"{location}: {option} is for {_either([form.name for form in having])}: remove it")


def _either(names: list[str]) -> str:
    return " or ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
