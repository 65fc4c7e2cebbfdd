"""Our scores of a published model next to the published ones."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from bevcli.evaluation.known_mistakes import known_mistakes

VALIDATION_FRAMES = 6019  # of the nuScenes validation split
# By the name of a score: its key in `FrameScores.to_dict`, and its unit.
SCORES = {
    "NDS": ("nd_score", "%"),
    "mAP": ("mean_ap", "%"),
    "mATE": ("trans_err", "m"),
    "mASE": ("scale_err", ""),
    "mAOE": ("orient_err", "rad"),
    "mAVE": ("vel_err", "m/s"),
    "mAAE": ("attr_err", ""),
}


@dataclass(frozen=True)
class ScorePair:
    """A score of ours and the published one. None: not measured, or not published."""

    name: str
    ours: float | None
    published: float | None

    @property
    def difference(self) -> float | None:
        """Ours minus the published one."""
        return None if self.ours is None or self.published is None else self.ours - self.published

    def cells(self) -> tuple[str, ...]:
        """The row of the table: name, ours, published, difference."""
        unit = SCORES[self.name][1] if self.name in SCORES else "%"
        scale, digits = (100, 1) if unit == "%" else (1, 3)

        def text(value: float | None, sign: str = "") -> str:
            return "–" if value is None else f"{scale * value:{sign}.{digits}f}"

        return f"{self.name} {unit}".strip(), text(self.ours), text(self.published), text(self.difference, "+")


@dataclass(frozen=True)
class Comparison:
    """Scores next to the published ones.

    Attributes:
        frames: number of frames that were scored.
        pairs: one a score.
        notes: why the numbers may differ, and known mistakes whose pattern they have.
    """

    frames: int
    pairs: tuple[ScorePair, ...]
    notes: tuple[str, ...]

    def table(self) -> str:
        """The scores as text for a terminal."""
        rows = [("score", "ours", "published", "difference"), *(pair.cells() for pair in self.pairs)]
        return "\n".join(
            f"{name:9} {ours:>7} {published:>10} {difference:>11}" for name, ours, published, difference in rows
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        pairs = {pair.name: {**asdict(pair), "difference": pair.difference} for pair in self.pairs}
        return {"frames": self.frames, "scores": pairs, "notes": list(self.notes)}


def compare_with_published(
    metrics: Mapping[str, Any], published: Mapping[str, float], *, temporal: bool = True
) -> Comparison:
    """Scores of a split next to the published ones.

    Args:
        metrics: of `joint_metrics`; all ten classes count, as in the published scores.
        published: by the names of SCORES; further names cannot be measured here.
        temporal: whether the model was run with history.
    """
    ours = {**metrics["tp_errors"], **{key: metrics[key] for key in ("nd_score", "mean_ap")}}
    pairs = [ScorePair(name, ours[key], published.get(name)) for name, (key, _) in SCORES.items()]
    others = [name for name in published if name not in SCORES]
    pairs += [ScorePair(name, None, published[name]) for name in others]
    notes = []
    if metrics["frames"] != VALIDATION_FRAMES:
        notes.append(
            f"the published scores are those of the {VALIDATION_FRAMES:,} frames of the validation split, these of "
            f"{metrics['frames']:,}: they need not agree"
        )
    if others:
        notes.append(f"{', '.join(others)}: not measured here; `bevcli eval --tracking` scores tracks")
    notes += known_mistakes(metrics, temporal=temporal)
    return Comparison(metrics["frames"], tuple(pairs), tuple(notes))
