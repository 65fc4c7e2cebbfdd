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
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING
from pathlib import Path
from typing import Any, Literal, TypeVar, dataclass_transform, get_type_hints

from bevcli.printing import did_you_mean

Reads = Literal["path", "path or name", "path or pattern"]
_Class = TypeVar("_Class", bound=type[Any])
_Options = TypeVar("_Options")


@dataclasses.dataclass(frozen=True)
class Option:
    """Help text and spelling of an option, for the command line and the documents.

    Attributes:
        help: one or two sentences for `--help` and the documents.
        panel: heading that the option stands under in `--help`; "" for that of its class.
        flag: spelling on the command line; "" for the field's name with dashes. With "--yes/--no", both; a short one
            may follow, as in "--out -o".
        metavar: name of the value in `--help`; "" for that of its type.
        parse: makes the value from the text of the command line; raises ValueError with the text and what was expected.
            None where the type says it.
        repeatable: whether the flag may be given several times; `parse` then takes the list of texts.
        flag_value: value that the flag alone stands for, such as "static" for --static. None for a flag with a value.
        complete: the values that complete a text in a shell.
        reads: "path" for a file or folder that is read, "path or name" where a name without suffix may stand for
            it, one of `complete` if that is given; "path or pattern" where a glob pattern may. The command line refuses
            a missing one before anything slow is imported.
        hidden: whether only Python has the option.
        is_argument: whether it is an argument of the command and no flag.
    """

    help: str
    panel: str = ""
    flag: str = ""
    metavar: str = ""
    parse: Callable[[Any], Any] | None = None
    repeatable: bool = False
    flag_value: Any = None
    complete: Callable[[str], Iterable[str]] | None = None
    minimum: float | None = None
    maximum: float | None = None
    reads: Reads | None = None
    hidden: bool = False
    is_argument: bool = False

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
    """Make a class a frozen dataclass of options. panel: heading of its options in `--help`."""

    def decorate(cls: _Class) -> _Class:
        made: Any = dataclasses.dataclass(frozen=True)(cls)
        made.panel = panel
        options = ((field.name, field.metadata.get("option")) for field in dataclasses.fields(made))
        attributes = [f"    {name}: {option.help}" for name, option in options if option]
        made.__doc__ = "\n".join([inspect.cleandoc(cls.__doc__ or ""), "", "Attributes:", *attributes])
        return made

    return decorate


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
        pairs[name] = value
    return pairs
