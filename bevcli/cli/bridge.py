"""Commands for typer from functions that take dataclasses of options, and the flags in place of arguments' names."""

import ast
import copy
import dataclasses
import difflib
import glob
import os
import re
import types
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from dataclasses import MISSING, Field, dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer

from bevcli.errors import BevcliError, InputError
from bevcli.options import Option, Reads, defaults, flag_of, option_of
from bevcli.printing import one_line, say

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]

# In an annotation of an argument, see `Option.reads`.
INPUT: Reads = "path"
INPUT_OR_NAME: Reads = "path or name"
INPUT_OR_PATTERN: Reads = "path or pattern"

_METAVARS = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}
_ARGUMENT = re.compile(r"`([a-z]\w*)(?:=([^`]*))?`")


@dataclass(frozen=True)
class Part:
    """The options that a command takes of a dataclass, in an annotation: `Annotated[ModelOptions, Part(only=…)]`.

    Attributes:
        only: names of its fields; empty for all of them.
        without: names of fields that the command does not have.
        classes: dataclasses whose fields the parameter, a mapping, gets by name. None: the annotated dataclass itself.
    """

    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    classes: Callable[[], Iterable[type[Any]]] | None = None

    def __contains__(self, name: str) -> bool:
        return name not in self.without and (not self.only or name in self.only)


class OldArgument:
    """In the annotation of an option: it was an argument, and is still taken as one for this release, with a note."""


@dataclass(frozen=True)
class _Old:
    """An earlier form of an option. option: its parameter. new: its flag. spelling: "" where it was an argument."""

    option: Parameter
    new: str
    spelling: str = ""

    @property
    def parameter(self) -> Parameter:
        """The hidden parameter of a function, as typer reads it."""
        kind, info, *_ = get_args(self.option.annotation)
        if self.spelling:
            info = copy.copy(info)
            info.default, info.param_decls, info.hidden = ..., (self.spelling,), True  # default has a spelling
        else:
            info = typer.Argument(hidden=True, metavar=f"[{self.option.name.upper()}]")
        kind, default = (bool, False) if kind is bool else (kind | None, None)
        name = f"{self.option.name}_{self.spelling.strip('-').replace('-', '_')}"
        return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])

    def move(self, given: dict[str, Any]) -> None:
        """Give its value to the option, with a note. Raises click's usage error."""
        value, name = given.pop(self.parameter.name), self.option.name
        if value in (None, [], ()) or value is False:
            return
        now = self.new if self.spelling else f"{self.new} {value}"
        if given[name] != self.option.default:
            raise typer.BadParameter(f"is given twice, also as {self.spelling or value}", param_hint=self.new)
        print_note(f"{self.spelling or f'the argument {value}'} is now {now}; the old form ends with this release")
        given[name] = value


@dataclass(frozen=True)
class _Read:
    """What is read. label: for messages. reads: see `Option`. names: those that may stand for a path."""

    label: str
    reads: Reads
    names: Callable[[str], Iterable[str]] | None = None

    def require(self, text: str) -> None:
        """Raise InputError for a path that does not exist, a pattern without matches, or an unknown name."""
        if "://" in text or _exists(Path(text)):
            return
        if self.reads == "path or name" and not Path(text).suffix and os.sep not in text:
            self._require_name(text)
        elif self.reads == "path or pattern" and glob.has_magic(text):
            if next(glob.iglob(text), None) is None:
                raise InputError(f"{text}: nothing matches this pattern (expected drives)")
        else:
            raise InputError(f"{text}: there is no such file or folder")

    def _require_name(self, text: str) -> None:
        known = None if self.names is None else list(self.names(""))
        if known is not None and text not in known:
            near = difflib.get_close_matches(text, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}, or a file"
            raise InputError(f"{self.label} {text}: is unknown: {hint}")


@dataclass(frozen=True)
class _Flag:
    """An option of a command. kind: type of the field. default: `Parameter.empty` for a required one."""

    field: Field[Any]
    option: Option
    kind: Any
    default: Any
    panel: str

    @property
    def yes(self) -> str:
        """Spelling without that of the opposite."""
        return flag_of(self.field).split()[0].partition("/")[0]

    @property
    def read(self) -> _Read | None:
        """What it names that is read, if anything."""
        reads = self.option.reads
        return None if reads is None else _Read(self.yes, reads, self.option.complete)

    def parameter(self, flags: Mapping[str, "_Flag"]) -> Parameter:
        """The parameter of a function, as typer reads it. flags: for the help text."""
        stated, default = self.option, self.default
        kind: Any = _plain(self.kind)
        if stated.flag_value is not None:
            kind, default = bool, False
        elif stated.repeatable or stated.parse is not None:
            kind = str if stated.parse is not None else get_args(self.kind)[0]
            kind = types.GenericAlias(list, (kind,)) if stated.repeatable else kind
            if default is not Parameter.empty:
                kind, default = kind | None, None
        info = typer.Option(
            *flag_of(self.field).split(),
            help=_with_flags(stated.help, flags),
            rich_help_panel=self.panel,
            metavar=stated.metavar or None,
            min=stated.minimum,
            max=stated.maximum,
            autocompletion=stated.complete,
            hidden=bool(stated.retired),
        )
        annotation = Annotated[kind, info]
        return Parameter(self.field.name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)

    def value(self, given: Any) -> Any:
        """The field's value for what typer has read; MISSING for its default. Raises click's usage error."""
        if self.option.retired and given != self.default:
            print_note(f"{self.yes} ends with this release: {self.option.retired}")
        if self.option.flag_value is not None:
            return self.option.flag_value if given else MISSING
        if self.option.parse is None and not self.option.repeatable:
            return given
        if given in (None, [], ()):
            return MISSING
        try:
            return tuple(given) if self.option.parse is None else self.option.parse(given)
        except ValueError as error:
            raise typer.BadParameter(str(error), param_hint=self.yes) from None


_flags: ContextVar[Mapping[str, _Flag]] = ContextVar("flags", default=types.MappingProxyType({}))


def command(function: Callable[..., None]) -> Callable[..., None]:
    """The function for typer: each parameter that is a dataclass of options becomes one parameter for each field.

    Arguments in backticks in a help text, and in a `BevcliError` of the function, become flags.
    """
    parts: list[Parameter | _Flag] = []
    arguments: list[str] = []
    flags: dict[str, _Flag] = {}
    makers: dict[str, tuple[Callable[..., Any], list[str]]] = {}
    inputs: dict[str, _Read] = {}
    hints = get_type_hints(function, include_extras=True)
    for parameter in signature(function).parameters.values():
        hint = hints[parameter.name]
        make, found = _flags_of(hint)
        if make is None:
            parts.append(parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=hint))
            marks = get_args(hint)[1:]  # of an Annotated
            if OldArgument in marks:
                arguments.append(parameter.name)
            for mark in (INPUT, INPUT_OR_NAME, INPUT_OR_PATTERN):
                if mark in marks:
                    names = getattr(marks[0], "autocompletion", None)
                    inputs[parameter.name] = _Read(f"--{parameter.name}", mark, names)
            continue
        for name in found.keys() & flags.keys():  # one of them is of another package
            raise BevcliError(f"command {function.__name__}: two options are named {name}: rename one")
        makers[parameter.name] = make, list(found)
        flags |= found
        inputs |= {name: flag.read for name, flag in found.items() if flag.read is not None}
        parts += found.values()

    def called(**given: Any) -> None:
        before = _flags.set(flags)
        try:
            for each in old:
                each.move(given)
            paths = [(given[name], read) for name, read in inputs.items()]
            for parameter, (make, names) in makers.items():
                values = {name: flags[name].value(given.pop(name)) for name in names}
                given[parameter] = make(**{name: value for name, value in values.items() if value is not MISSING})
            _require_inputs(paths)
            function(**given)
        except BevcliError as error:
            error.args = (as_flags(str(error)), *error.args[1:])
            raise
        finally:
            _flags.reset(before)

    called.__name__, called.__doc__, called.__module__ = function.__name__, function.__doc__, function.__module__
    parameters = [part.parameter(flags) if isinstance(part, _Flag) else part for part in parts]
    spelled = [(each, text) for each in parameters if each.name in flags for text in flags[each.name].option.old]
    old = [_Old(each, flags[each.name].yes, text) for each, text in spelled]
    old += [_Old(each, f"--{each.name}") for each in parameters if each.name in arguments]
    made = [*parameters, *(each.parameter for each in old)]
    called.__signature__ = Signature([_with_metavar(each) for each in made])  # type: ignore[attr-defined]
    return called


def _require_inputs(given: Iterable[tuple[Any, _Read]]) -> None:
    """Raise InputError for what does not exist, before anything is imported that takes seconds."""
    for values, read in given:
        for value in values if isinstance(values, list | tuple) else [values]:
            if value is not None and str(value):
                read.require(str(value))


def _exists(path: Path) -> bool:
    """False for a path without a file, or the partial file of a killed run. Other errors are told where it is read."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):
        from bevcli.sequences.files.incremental_json import partial_path

        return bool(path.name) and partial_path(path).exists()
    except OSError:
        return True
    return True


def as_flags(text: str) -> str:
    """A text of the library for the command line: the running command's arguments in backticks become its flags."""
    return _with_flags(text, _flags.get())


def print_note(text: str) -> None:
    """Print a note of the library to stderr."""
    say(f"note: {one_line(as_flags(text))}", err=True)


def _with_flags(text: str, flags: Mapping[str, _Flag]) -> str:
    def flag(found: re.Match[str]) -> str:
        return _as_flag(flags[found[1]], found[2]) if found[1] in flags else found[0]

    return _ARGUMENT.sub(flag, text)


def _as_flag(flag: _Flag, value: str | None) -> str:
    """The flag with a value that a text of the library states as Python."""
    if value is None:
        return flag.yes
    try:
        literal = ast.literal_eval(value)
    except (ValueError, SyntaxError):
        literal = value
    if literal is False:
        return flag_of(flag.field).split()[0].partition("/")[2] or f"no {flag.yes}"
    if flag.kind is bool or flag.option.flag_value is not None:
        return flag.yes
    if isinstance(literal, dict):
        return " ".join(f"{flag.yes} {key}={each}" for key, each in literal.items())
    if isinstance(literal, tuple | list):
        literal = ",".join(map(str, literal))
    return f"{flag.yes} {literal}"


def _flags_of(hint: Any) -> tuple[Callable[..., Any] | None, dict[str, _Flag]]:
    """The maker of a parameter's value, and its options by name; None for a parameter without options."""
    part = Part()
    if get_origin(hint) is Annotated:
        hint, *extras = get_args(hint)
        part = next((each for each in extras if isinstance(each, Part)), part)
    if part.classes is None and not dataclasses.is_dataclass(hint):
        return None, {}
    found: dict[str, _Flag] = {}
    for kind in [hint] if part.classes is None else part.classes():
        kinds, known = get_type_hints(kind), defaults(kind)
        for field in dataclasses.fields(kind):
            stated = option_of(field)
            if stated is not None and not stated.hidden and field.name in part:
                default = known.get(field.name, Parameter.empty)
                flag = _Flag(field, stated, kinds[field.name], default, stated.panel or kind.panel)
                found.setdefault(field.name, flag)
    assert set(part.only) <= found.keys(), f"{hint}: {part.only}"
    return (dict if part.classes else hint), found


def _with_metavar(parameter: Parameter) -> Parameter:
    """The parameter with a name for its value in `--help`: that of an argument, else PATH, TEXT or the choices."""
    whole: Any
    whole, *marks = get_args(parameter.annotation) if get_origin(parameter.annotation) is Annotated else [None]
    info = next((each for each in marks if isinstance(each, typer.models.ParameterInfo)), None)
    if info is None or info.metavar is not None:
        return parameter
    kinds = [each for each in get_args(whole) if each is not type(None)] if get_origin(whole) is not Literal else []
    kind = kinds[0] if kinds else whole
    kind = get_args(kind)[0] if get_origin(kind) is list else kind
    if kind is bool:
        return parameter
    info = copy.copy(info)
    if isinstance(info, typer.models.ArgumentInfo):
        info.metavar = parameter.name.upper()
    else:
        info.metavar = "|".join(get_args(kind)) or _METAVARS.get(kind)
    return parameter.replace(annotation=Annotated[whole, info])


def _plain(hint: Any) -> Any:
    """The type that typer parses: of several that Python takes, such as `str | Path | None`, the path."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return (Path | None if type(None) in kinds else Path) if Path in kinds else hint
