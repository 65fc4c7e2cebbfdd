"""Options, each stated once: a frozen dataclass whose fields carry type, default, help text and panel.

Python takes the dataclass or keywords, the command line makes its flags from the fields, and docs/commands.md is made
from them too. The help text is also what the class's docstring says of the attribute: it stands nowhere else.

    @options("Input")
    class InputOptions:
        \"""Options of every input format.\"""

        rate_hz: float | None = option(default=None, help="Thin to this many frames per second.", flag="--rate")

A text of the library names an option as both spell it: "pass `rate_hz` (`--rate`)"; a help text names its flag.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, dataclass_transform, get_args, get_origin, get_type_hints

from bevcli.errors import InputError
from bevcli.printing import did_you_mean, one_line

Reads = Literal["path", "path or name", "path or pattern"]
_Class = TypeVar("_Class", bound=type[Any])
_Options = TypeVar("_Options")
_TEXTS = {str, Path, Any, Sequence, Iterable}  # types of options that take any text


@dataclasses.dataclass(frozen=True)
class Option:
    """Help text and spelling of an option, for the command line and the documents."""

    help: str  # one or two sentences for `--help` and the documents
    panel: str = ""  # heading that the option stands under in `--help`; "" for that of its class
    # spelling on the command line; "" for the field's name with dashes. With "--yes/--no", both; a short one may
    # follow, as in "--out -o"
    flag: str = ""
    metavar: str = ""  # name of the value in `--help`; "" for that of its type
    # makes the value from the text of the command line; raises ValueError with the text and what was expected. None
    # where the type says it
    parse: Callable[[Any], Any] | None = None
    repeatable: bool = False  # whether the flag may be given several times; `parse` then takes the list of texts
    # value that the flag alone stands for, such as "static" for --static. None for a flag with a value
    flag_value: Any = None
    complete: Callable[[str], Iterable[str]] | None = None  # the values that complete a text in a shell
    minimum: float | None = None
    maximum: float | None = None
    # "path" for a file or folder that is read, "path or name" where a name without suffix may stand for it, one of
    # `complete` if that is given; "path or pattern" where a glob pattern may. The command line refuses a missing one
    # before anything slow is imported
    reads: Reads | None = None
    hidden: bool = False  # whether only Python has the option
    is_argument: bool = False  # whether it is an argument of the command and no flag
    mistaken: str = ""  # end of the error about a text that means nothing: the option that it may be for

    def spellings(self, name: str) -> list[str]:
        """Those on the command line, such as "--rate" or "--track/--no-track"; --out is -o, too. name: the field."""
        return (self.flag or f"--{name.replace('_', '-')}{' -o' if name == 'out' else ''}").split()


def option(
    *, default: Any = MISSING, default_factory: Callable[[], Any] | Any = MISSING, help: str, **settings: Any
) -> Any:
    """A field of a dataclass of options. settings: of `Option`."""
    kept: dict[str, Any] = {"default": default, "default_factory": default_factory}
    return dataclasses.field(**kept, metadata={"option": Option(help, **settings)})


@dataclass_transform(frozen_default=True, field_specifiers=(option, dataclasses.field))
def options(panel: str = "Options") -> Callable[[_Class], _Class]:
    """Make a class a frozen dataclass of options, which refuses values that mean nothing by an InputError.

    panel: heading of its options in `--help`.
    """

    def decorate(cls: _Class) -> _Class:
        own_check = getattr(cls, "__post_init__", None)

        def check(self: Any) -> None:
            _check_texts(self)
            if own_check is not None:
                own_check(self)
            _check_ranges(self)

        cls.__post_init__ = check
        made: Any = dataclasses.dataclass(frozen=True)(cls)
        made.panel = panel
        options = ((field.name, field.metadata.get("option")) for field in dataclasses.fields(made))
        attributes = [f"    {name}: {option.help}" for name, option in options if option]
        made.__doc__ = "\n".join([inspect.cleandoc(cls.__doc__ or ""), "", "Attributes:", *attributes])
        return made

    return decorate


def _check_texts(made: Any) -> None:
    """Raise InputError for a text where the option's type has no such text."""
    for field in dataclasses.fields(made):
        value, option = getattr(made, field.name), field.metadata.get("option")
        if option is not None and isinstance(value, str):
            kinds = _kinds(type(made), field.name)  # type: ignore[arg-type]
            texts = [text for kind in kinds if get_origin(kind) is Literal for text in get_args(kind)]
            if value not in texts and not _TEXTS.intersection(kinds):
                others = [kind.__name__ for kind in kinds if isinstance(kind, type) and kind is not type(None)]
                wrong = f"means nothing (expected {', '.join([*texts, *others])}{option.mistaken})"
                raise InputError(f"{_with_value(made, field.name)}: {wrong}")


def _check_ranges(made: Any) -> None:
    """Raise InputError for a number outside the range of its option."""
    for field in dataclasses.fields(made):
        value, option = getattr(made, field.name), field.metadata.get("option")
        numbers = [n for n in (value if isinstance(value, tuple) else (value,)) if isinstance(n, int | float)]
        if option is not None and numbers:
            low, high = option.minimum, option.maximum
            if (low is not None and not min(numbers) >= low) or (high is not None and not max(numbers) <= high):
                limits = f"{low:g} to {high:g}" if None not in (low, high) else f"{low if high is None else high:g}"
                ending = "" if None not in (low, high) else " or more" if high is None else " or less"
                raise InputError(f"{_with_value(made, field.name)}: expected {limits}{ending}")


def _with_value(made: Any, name: str) -> str:
    """An option and its value in a text: "`every=0` (`--every`)"."""
    return named(type(made), name).replace(f"`{name}`", f"`{name}={one_line(getattr(made, name), 60)}`", 1)


@functools.cache
def _kinds(cls: type[Any], name: str) -> tuple[Any, ...]:
    """The types of an option: those of a union, or the one."""
    hint = get_type_hints(cls)[name]
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return tuple(get_origin(kind) or kind if get_origin(kind) is not Literal else kind for kind in kinds)


def named(cls: type[Any], name: str) -> str:
    """An option of a dataclass in a text for both, Python and the command line: "`rate_hz` (`--rate`)"."""
    (field,) = (field for field in dataclasses.fields(cls) if field.name == name)
    return f"`{name}` (`{field.metadata['option'].spellings(name)[0].partition('/')[0]}`)"


def gather(cls: type[_Options], options: _Options | None, changes: Mapping[str, Any]) -> _Options:
    """The options of a call that takes the dataclass or keywords: `options` or the defaults, with the changes.

    A text becomes a Path where the field is one, and one or a list of them a tuple where the field is that. Raises
    TypeError for a keyword that the dataclass does not have.
    """
    hints = get_type_hints(cls)
    made = {name: _as_paths(value, hints.get(name)) for name, value in changes.items()}
    if options is None:
        return cls(**made)
    return dataclasses.replace(options, **made) if made else options  # type: ignore[type-var]


def _as_paths(value: Any, hint: Any) -> Any:
    """The value of a field, as paths where its type says so."""
    if hint == tuple[Path, ...]:
        return tuple(map(Path, [value] if isinstance(value, str | Path) else value))
    return Path(value) if hint in (Path, Path | None) and isinstance(value, str) else value


def spread(changes: Mapping[str, Any], *kinds: type[Any]) -> tuple[Any, ...]:
    """Keywords of a call, spread over dataclasses of options; last, a dict of those that are in none of them."""
    rest, made = dict(changes), []
    for cls in kinds:
        names = [field.name for field in dataclasses.fields(cls) if field.name in changes]
        made.append(gather(cls, None, {name: changes[name] for name in names}))
        for name in names:
            rest.pop(name, None)
    return (*made, rest)


def refuse(rest: Mapping[str, Any], function: str, *kinds: type[Any]) -> None:
    """Raise TypeError for keywords that a function does not take. kinds: the dataclasses of its options."""
    if rest:
        name, names = next(iter(rest)), [field.name for cls in kinds for field in dataclasses.fields(cls)]
        hint = did_you_mean(name, names, f"expected some of {', '.join(sorted(set(names)))}")
        raise TypeError(f"{function}() has no option {name}: {hint}")


def defaults(cls: type[Any]) -> dict[str, Any]:
    """The default of each option of a dataclass that has one."""
    values = {}
    for field in dataclasses.fields(cls):
        if field.default_factory is not MISSING:
            values[field.name] = field.default_factory()
        elif field.default is not MISSING:
            values[field.name] = field.default
    return values


def parse_pairs(texts: Iterable[str], expected: str) -> dict[str, str]:
    """The texts "NAME=VALUE" of a repeated option as a mapping. Raises ValueError; expected: for its message."""
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise ValueError(f'"{text}" (expected {expected})')
        if name in pairs:
            raise ValueError(f'"{text}" (expected {name} once)')
        pairs[name] = value
    return pairs
