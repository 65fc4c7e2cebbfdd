"""Commands for typer from functions that take dataclasses of options."""

import dataclasses
import difflib
import glob
import os
import types
from collections.abc import Callable
from dataclasses import MISSING, dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import typer

from bevcli.errors import BevcliError, InputError
from bevcli.inference.options import complete_model
from bevcli.options import Option, Reads, defaults
from bevcli.registry import is_of_hub
from bevcli.sequences.format import option_classes

_METAVARS = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}


def argument(help: str, reads: Reads | None = "path", **settings: Any) -> Option:
    """An argument of a command, in the annotation of a parameter. reads, settings: of `Option`."""
    return Option(help, is_argument=True, reads=reads, **settings)


def model_option(help: str, panel: str = "Model", **settings: Any) -> Option:
    """The option --model of a command that does not take it as a field. settings: of `Option`."""
    return Option(help, panel, metavar="NAME|FILE", complete=complete_model, reads="path or name", **settings)


FormatValues = dict[str, Any]  # a parameter with the options of all input formats, by name
Json = Annotated[bool, Option("Print one JSON object instead of text.", flag="--json")]
InputDrive = Annotated[
    Path, argument("Sequence folder (images or videos), a video, nuScenes root, .mcap file or rosbag2 folder.")
]


@dataclass(frozen=True)
class Part:
    """The options that a command takes of a dataclass, in an annotation: `Annotated[ModelOptions, Part(only=…)]`.

    Or those that it takes of `FormatValues`.

    Attributes:
        only: names of its fields; empty for all of them.
        without: names of fields that the command does not have.
        classes: makes the list of the dataclasses whose options are in `FormatValues`.
    """

    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    classes: Callable[[], list[type[Any]]] = option_classes


@dataclass(frozen=True)
class _Flag:
    """An option or an argument of a command.

    Attributes:
        name: of the field or the function's parameter.
        option: as it is stated.
        kind: type of the value.
        default: `Parameter.empty` if it is required.
        panel: heading in `--help`.
    """

    name: str
    option: Option
    kind: Any
    default: Any
    panel: str | None

    @property
    def spellings(self) -> list[str]:
        return self.option.spellings(self.name)

    @property
    def yes(self) -> str:
        """Spelling without that of the opposite."""
        return self.spellings[0].partition("/")[0]

    def parameter(self) -> Parameter:
        """The parameter of a function, as typer reads it."""
        stated, kind, default = self.option, self.kind, self.default
        kinds = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
        if Path in kinds:  # of several that Python takes, such as `str | Path | None`
            kind = Path | None if type(None) in kinds else Path
        if stated.flag_value is not None:
            kind, default = bool, False
        elif stated.repeatable or stated.parse is not None:
            kind = str if stated.parse is not None else get_args(self.kind)[0]
            kind = types.GenericAlias(list, (kind,)) if stated.repeatable else kind
            if default is not Parameter.empty:
                kind, default = kind | None, None
        value = kind  # what `--help` calls by its name: PATH, TEXT or the choices
        while get_origin(value) in (list, tuple, Union, types.UnionType):
            value = get_args(value)[0]
        metavar = None if value is bool else "|".join(get_args(value)) or _METAVARS.get(value)
        settings: dict[str, Any] = {
            "help": stated.help,
            "metavar": stated.metavar or (self.name.upper() if stated.is_argument else metavar),
        }
        if stated.is_argument:
            info = typer.Argument(**settings)
        else:
            settings |= {"min": stated.minimum, "max": stated.maximum, "autocompletion": stated.complete}
            info = typer.Option(*self.spellings, rich_help_panel=self.panel, **settings)
        return Parameter(self.name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])

    def value(self, given: Any) -> Any:
        """The field's value for what typer has read; MISSING for its default. Raises click's usage error."""
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


def command(function: Callable[..., None]) -> Callable[..., dict[str, Any]]:
    """The arguments of a function from what typer has read, for `PlainCommand`, which calls the function itself.

    Each parameter that is a dataclass of options becomes one parameter for each field.
    """
    parts: list[Parameter | _Flag] = []
    flags: dict[str, _Flag] = {}
    makers: dict[str, tuple[Callable[..., Any], dict[str, _Flag]]] = {}
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in signature(function).parameters.items():
        hint, marks = hints[name], getattr(hints[name], "__metadata__", ())
        make, fields = _flags_of(hint)
        for twice in fields.keys() & flags.keys():  # one of them is of another package
            raise BevcliError(f"command {function.__name__}: two options are named {twice}: rename one")
        if make is not None:
            makers[name] = make, fields
        elif marks and isinstance(marks[0], Option):
            parts.append(_Flag(name, marks[0], get_args(hint)[0], parameter.default, marks[0].panel or None))
        else:  # without an `Option` it stays as typer has it
            parts.append(parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=hint))
        flags |= fields
        parts += fields.values()
    inputs = [part for part in parts if isinstance(part, _Flag) and part.option.reads]

    def arguments(**given: Any) -> dict[str, Any]:
        read = [(given[flag.name], flag) for flag in inputs]
        for parameter, (make, fields) in makers.items():
            values = {name: flag.value(given.pop(name)) for name, flag in fields.items()}
            given[parameter] = make(**{name: value for name, value in values.items() if value is not MISSING})
        for value, flag in read:  # before anything is imported that takes seconds
            _require(value, flag)
        return given

    arguments.__name__, arguments.__doc__ = function.__name__, function.__doc__
    arguments.__module__ = function.__module__
    made = [part.parameter() if isinstance(part, _Flag) else part for part in parts]
    vars(arguments).update(__signature__=Signature(made), function=function)
    return arguments


def _require(value: Any, flag: _Flag) -> None:
    """Raise InputError for a path that does not exist, a pattern without matches, or an unknown name.

    The partial file of a killed run counts as the file. Other errors of a path are told where it is read.

    value: one or several, or None.
    """
    reads, complete = flag.option.reads, flag.option.complete
    for text in map(str, value if isinstance(value, list | tuple) else [value or ""]):
        if not text or "://" in text or (reads == "path or name" and is_of_hub(text)):
            continue
        try:
            Path(text).stat()
            continue
        except (FileNotFoundError, NotADirectoryError, ValueError):
            from bevcli.sequences.files.incremental_json import partial_path

            if Path(text).name and partial_path(Path(text)).exists():
                continue
        except OSError:
            continue
        if reads == "path or name" and not Path(text).suffix and os.sep not in text:
            if complete is not None and text not in complete(""):
                names = sorted(complete(""))
                near = difflib.get_close_matches(text, names, n=1)
                hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(names)}, or a file"
                raise InputError(f"{flag.yes} {text}: is unknown: {hint}")
        elif reads != "path or pattern" or not glob.has_magic(text):
            raise InputError(f"{text}: there is no such file or folder")
        elif next(glob.iglob(text), None) is None:
            raise InputError(f"{text}: nothing matches this pattern (expected drives)")


def _flags_of(hint: Any) -> tuple[Callable[..., Any] | None, dict[str, _Flag]]:
    """The maker of a parameter's value, and its options by name; None for a parameter without options."""
    marks = getattr(hint, "__metadata__", ())
    hint = get_args(hint)[0] if marks else hint
    part = next((mark for mark in marks if isinstance(mark, Part)), Part())
    make: Callable[..., Any] = hint
    classes: list[type[Any]] = [hint]
    if hint == FormatValues:
        make, classes = dict, part.classes()
    elif not dataclasses.is_dataclass(hint):
        return None, {}
    flags: dict[str, _Flag] = {}
    for kind in classes:
        kinds, values = get_type_hints(kind), defaults(kind)
        for field in dataclasses.fields(kind):
            stated, name = field.metadata.get("option"), field.name
            is_taken = name not in part.without and (not part.only or name in part.only)
            if stated is not None and not stated.hidden and is_taken:
                default = values.get(name, Parameter.empty)
                flags.setdefault(name, _Flag(name, stated, kinds[name], default, stated.panel or kind.panel))
    assert set(part.only) <= flags.keys(), f"{hint}: {part.only}"
    return make, flags
