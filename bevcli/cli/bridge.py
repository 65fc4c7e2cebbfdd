"""Commands for typer from functions that take dataclasses of options."""

import dataclasses
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
from bevcli.inference import complete_model
from bevcli.options import Option, Reads, defaults
from bevcli.printing import did_you_mean
from bevcli.registry import is_of_hub
from bevcli.sequences.format import formats
from bevcli.writing import partial_path

_METAVARS = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}
_UNIONS = (Union, types.UnionType)


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
    """The options that a command takes of a dataclass or of `FormatValues`: `Annotated[ModelOptions, Part(only=…)]`."""

    only: tuple[str, ...] = ()  # names of its fields; empty for all of them
    without: tuple[str, ...] = ()  # names of fields that the command does not have


@dataclass(frozen=True)
class _Flag:
    """An option or an argument of a command."""

    name: str  # of the field or the function's parameter
    option: Option  # as it is stated
    kind: Any  # type of the value
    default: Any  # `Parameter.empty` if it is required
    panel: str | None  # heading in `--help`

    def parameter(self) -> Parameter:
        """The parameter of a function, as typer reads it."""
        option, annotation, default = self.option, self.kind, self.default
        kinds = get_args(annotation) if get_origin(annotation) in _UNIONS else (annotation,)
        if Path in kinds:  # of several that Python takes, such as `str | Path | None`
            annotation = Path | None if type(None) in kinds else Path
        if option.flag_value is not None:
            annotation, default = bool, False
        elif option.repeatable or option.parse is not None:
            annotation = str if option.parse is not None else get_args(self.kind)[0]
            annotation = types.GenericAlias(list, (annotation,)) if option.repeatable else annotation
            if default is not Parameter.empty:
                annotation, default = annotation | None, None
        value = annotation  # what `--help` calls by its name: PATH, TEXT or the choices
        while get_origin(value) in (list, tuple, *_UNIONS):
            value = get_args(value)[0]
        metavar = self.name.upper() if option.is_argument else "|".join(get_args(value)) or _METAVARS.get(value)
        settings: dict[str, Any] = {"help": option.help, "metavar": option.metavar or metavar}
        if value is Path:
            settings["parser"] = _path
        if option.is_argument:
            info = typer.Argument(**settings)
        else:
            settings |= {"min": option.minimum, "max": option.maximum, "autocompletion": option.complete}
            info = typer.Option(*option.spellings(self.name), rich_help_panel=self.panel, **settings)
        return Parameter(self.name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[annotation, info])

    def value(self, argument: Any) -> Any:
        """The field's value for what typer has read; MISSING for its default. Raises click's usage error."""
        if self.option.flag_value is not None:
            return self.option.flag_value if argument else MISSING
        if self.option.parse is None and not self.option.repeatable:
            return argument
        if argument in (None, [], ()):
            return MISSING
        try:
            return tuple(argument) if self.option.parse is None else self.option.parse(argument)
        except ValueError as error:
            name = self.option.spellings(self.name)[0]
            raise typer.BadParameter(str(error), param_hint=name) from None


def _path(text: str) -> Path:
    """A path; an empty one, as of a variable that is not set, would be the current folder."""
    if not text:
        raise typer.BadParameter("is empty (expected a path, . for this folder)")
    return Path(text)


def command(function: Callable[..., None]) -> Callable[..., None]:
    """The function with a parameter for each field of its dataclasses of options, as typer reads it."""
    parts: list[Parameter | _Flag] = []
    makers: dict[str, tuple[Callable[..., Any], dict[str, _Flag]]] = {}
    names: set[str] = set()
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in signature(function).parameters.items():
        hint, *marks = get_args(hints[name]) if get_origin(hints[name]) is Annotated else (hints[name],)
        if hint == FormatValues or dataclasses.is_dataclass(hint):
            part = next((mark for mark in marks if isinstance(mark, Part)), Part())
            fields = _flags_of(hint, part)
            for twice in fields.keys() & names:  # one of them is of another package
                raise BevcliError(f"command {function.__name__}: two options are named {twice}: rename one")
            names |= fields.keys()
            makers[name] = dict if hint == FormatValues else hint, fields
            parts += fields.values()
        elif marks and isinstance(marks[0], Option):
            parts.append(_Flag(name, marks[0], hint, parameter.default, marks[0].panel or None))
        else:  # without an `Option` it stays as typer has it
            parts.append(parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[name]))
    inputs = [part for part in parts if isinstance(part, _Flag) and part.option.reads]

    def run(**arguments: Any) -> None:
        read = [(arguments[flag.name], flag) for flag in inputs]
        for parameter, (make, fields) in makers.items():
            values = {name: flag.value(arguments.pop(name)) for name, flag in fields.items()}
            arguments[parameter] = make(**{name: value for name, value in values.items() if value is not MISSING})
        for value, flag in read:  # before anything is imported that takes seconds
            _require(value, flag)
        function(**arguments)

    run.__name__, run.__doc__, run.__module__ = function.__name__, function.__doc__, function.__module__
    made = [part.parameter() if isinstance(part, _Flag) else part for part in parts]
    vars(run)["__signature__"] = Signature(made)
    return run


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
            if Path(text).name and partial_path(Path(text)).exists():
                continue
        except OSError:
            continue
        if reads == "path or name" and not Path(text).suffix and os.sep not in text:
            if complete is not None and text not in complete(""):
                names = sorted(complete(""))
                hint = did_you_mean(text, names, f"expected one of {', '.join(names)}, or a file")
                raise InputError(f"{flag.option.spellings(flag.name)[0]} {text}: is unknown: {hint}")
        elif reads != "path or pattern" or not glob.has_magic(text):
            raise InputError(f"{text}: there is no such file or folder")
        elif next(glob.iglob(text), None) is None:
            raise InputError(f"{text}: nothing matches this pattern (expected drives)")


def _flags_of(hint: Any, part: Part) -> dict[str, _Flag]:
    """The options that a command takes of a dataclass or of all formats, by the names of the fields."""
    flags: dict[str, _Flag] = {}
    classes: list[type[Any]] = [*formats()] if hint == FormatValues else [hint]
    for cls in classes:
        kinds, values = get_type_hints(cls), defaults(cls)
        for field in dataclasses.fields(cls):
            option, name = field.metadata.get("option"), field.name
            is_taken = name not in part.without and (not part.only or name in part.only)
            if option is not None and not option.hidden and is_taken:
                default = values.get(name, Parameter.empty)
                flags.setdefault(name, _Flag(name, option, kinds[name], default, option.panel or cls.panel))
    assert set(part.only) <= flags.keys(), f"{hint}: {part.only}"
    return flags
