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
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import typer

from bevcli.errors import BevcliError, InputError
from bevcli.inference.options import complete_model
from bevcli.options import Option, Reads, defaults, option_of
from bevcli.printing import one_line, say

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]

_METAVARS = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}
_ARGUMENT = re.compile(r"`([a-z]\w*)(?:=([^`]*))?`")


def input_argument(help: str, reads: Reads = "path", **settings: Any) -> Any:
    """The argument, for typer, of what is read, see `Option.reads`. settings: of `typer.Argument`."""
    info = typer.Argument(help=help, **settings)
    info.reads = reads
    return info


_DRIVE = "Sequence folder (images or videos), nuScenes root, .mcap file or rosbag2 folder."
InputDrive = Annotated[Path, input_argument(_DRIVE)]


def model_option(help: str, panel: str | None = "Model", **settings: Any) -> Any:
    """The option --model, for typer, of a command that does not take it as a field. settings: of `typer.Option`."""
    info = typer.Option(
        autocompletion=complete_model, metavar="NAME|FILE", help=help, rich_help_panel=panel, **settings
    )
    info.reads = "path or name"
    return info


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
class _Flag:
    """An option of a command. kind: type of the field. default: `Parameter.empty` for a required one."""

    field: Field[Any]
    option: Option
    kind: Any
    default: Any
    panel: str

    @property
    def spellings(self) -> list[str]:
        """Those on the command line, such as "--rate" or "--track/--no-track"; --out is -o, too."""
        short = " -o" if self.field.name == "out" else ""
        return (self.option.flag or f"--{self.field.name.replace('_', '-')}{short}").split()

    @property
    def yes(self) -> str:
        """Spelling without that of the opposite."""
        return self.spellings[0].partition("/")[0]

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
            *self.spellings,
            help=_with_flags(stated.help, flags),
            rich_help_panel=self.panel,
            metavar=stated.metavar or None,
            min=stated.minimum,
            max=stated.maximum,
            autocompletion=stated.complete,
            hidden=bool(stated.retired),
        )
        info.reads = stated.reads
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
    flags: dict[str, _Flag] = {}
    makers: dict[str, tuple[Callable[..., Any], dict[str, _Flag]]] = {}
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in signature(function).parameters.items():
        make, found = _flags_of(hints[name])
        for twice in found.keys() & flags.keys():  # one of them is of another package
            raise BevcliError(f"command {function.__name__}: two options are named {twice}: rename one")
        if make is None:
            parts.append(parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[name]))
        else:
            makers[name] = make, found
        flags |= found
        parts += found.values()

    def called(**given: Any) -> None:
        before = _flags.set(flags)
        try:
            for earlier in old:
                earlier.move(given)
            read = [(given[name], *how) for name, how in inputs.items()]
            for parameter, (make, found) in makers.items():
                values = {name: flag.value(given.pop(name)) for name, flag in found.items()}
                given[parameter] = make(**{name: value for name, value in values.items() if value is not MISSING})
            for each in read:  # before anything is imported that takes seconds
                _require(*each)
            function(**given)
        except BevcliError as error:
            error.args = (as_flags(str(error)), *error.args[1:])
            raise
        finally:
            _flags.reset(before)

    called.__name__, called.__doc__, called.__module__ = function.__name__, function.__doc__, function.__module__
    parameters = [part.parameter(flags) if isinstance(part, _Flag) else part for part in parts]
    spelled = {each.name: flags[each.name].yes if each.name in flags else f"--{each.name}" for each in parameters}
    infos = {each.name: _info_in(each.annotation) for each in parameters}
    inputs = {name: (spelled[name], info) for name, info in infos.items() if getattr(info, "reads", None)}
    retired = [(each, text) for each in parameters if each.name in flags for text in flags[each.name].option.old]
    retired += [(each, "") for each in parameters if OldArgument in get_args(each.annotation)]
    old = [_Old(each, spelled[each.name], text) for each, text in retired]
    made = [*parameters, *(each.parameter for each in old)]
    called.__signature__ = Signature([_with_metavar(each) for each in made])  # type: ignore[attr-defined]
    return called


def _require(value: Any, flag: str, info: Any) -> None:
    """Raise InputError for a path that does not exist, a pattern without matches, or an unknown name.

    value: one or several, or None. info: of typer, with `reads`.
    """
    for text in map(str, value if isinstance(value, list | tuple) else [value or ""]):
        if not text or "://" in text or _exists(Path(text)):
            continue
        if info.reads == "path or name" and not Path(text).suffix and os.sep not in text:
            known = [text] if info.autocompletion is None else list(info.autocompletion(""))
            if text not in known:
                near = difflib.get_close_matches(text, known, n=1)
                hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}, or a file"
                raise InputError(f"{flag} {text}: is unknown: {hint}")
        elif info.reads != "path or pattern" or not glob.has_magic(text):
            raise InputError(f"{text}: there is no such file or folder")
        elif next(glob.iglob(text), None) is None:
            raise InputError(f"{text}: nothing matches this pattern (expected drives)")


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
        return flag.spellings[0].partition("/")[2] or f"no {flag.yes}"
    if flag.kind is bool or flag.option.flag_value is not None:
        return flag.yes
    if isinstance(literal, dict):
        return " ".join(f"{flag.yes} {key}={each}" for key, each in literal.items())
    if isinstance(literal, tuple | list):
        literal = ",".join(map(str, literal))
    return f"{flag.yes} {literal}"


def _flags_of(hint: Any) -> tuple[Callable[..., Any] | None, dict[str, _Flag]]:
    """The maker of a parameter's value, and its options by name; None for a parameter without options."""
    hint, marks = _unmarked(hint)
    part = next((each for each in marks if isinstance(each, Part)), Part())
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


def _unmarked(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """The type in an annotation, and the marks of an Annotated."""
    return (get_args(hint)[0], hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())


def _info_in(hint: Any) -> Any:
    """The `typer.Argument` or `typer.Option` in an annotation, or None."""
    return next((each for each in _unmarked(hint)[1] if isinstance(each, typer.models.ParameterInfo)), None)


def _with_metavar(parameter: Parameter) -> Parameter:
    """The parameter with a name for its value in `--help`: that of an argument, else PATH, TEXT or the choices."""
    info, (whole, _) = copy.copy(_info_in(parameter.annotation)), _unmarked(parameter.annotation)
    kind = whole
    while get_origin(kind) in (list, tuple, Union, types.UnionType):
        kind = get_args(kind)[0]
    if info is None or info.metavar is not None or kind is bool:
        return parameter
    if isinstance(info, typer.models.ArgumentInfo):
        info.metavar = parameter.name.upper()
    else:
        info.metavar = "|".join(get_args(kind)) or _METAVARS.get(kind)
    return parameter.replace(annotation=Annotated[whole, info])


def _plain(hint: Any) -> Any:
    """The type that typer parses: of several that Python takes, such as `str | Path | None`, the path."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return (Path | None if type(None) in kinds else Path) if Path in kinds else hint
