"""Scorer: the scores of further results of a model, such as tracks, registered under `bevcli.scores`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final, Protocol

from bevcli.options import defaults
from bevcli.registry import entries, load

if TYPE_CHECKING:
    from bevcli.evaluation.inputs import Compared

GROUP: Final = "bevcli.scores"


class ResultScores(Protocol):
    """The scores of one kind of results."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed or left out, one line each."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Further members of the JSON object of the scores."""
        ...

    def tables(self) -> Iterable[str]:
        """Further tables for a terminal."""
        ...


@dataclass(frozen=True)
class Scorer:
    """What computes the scores of one kind of results.

    Attributes:
        options: a dataclass of options, which are False by default. One that is True turns the scorer on.
        function: "module:function", imported when it is used. It takes the options and a `Compared`, and returns
            `ResultScores`. It raises InputError where a side lacks what is scored.
    """

    options: type[Any]
    function: str

    def score(self, options: Any, compared: Compared) -> ResultScores:
        scores: ResultScores = resolve_name(self.function)(options, compared)
        return scores


def score_options() -> list[type[Any]]:
    """The dataclasses of the scorers' options."""
    return [load(GROUP, name).options for name in entries(GROUP)]


def score_results(values: Mapping[str, bool], compared: Compared) -> dict[str, ResultScores]:
    """The scores that options ask for, by the name of their scorer. Raises InputError as `Scorer` says.

    values: by option.
    """
    scores, unknown = {}, set(values)
    for name in entries(GROUP) if values else ():
        scorer = load(GROUP, name)
        own = {option: values[option] for option in defaults(scorer.options) if option in values}
        unknown -= own.keys()
        if any(own.values()):
            scores[name] = scorer.score(scorer.options(**own), compared)
    if unknown:
        raise TypeError(f"evaluate() has no option `{unknown.pop()}`")
    return scores
