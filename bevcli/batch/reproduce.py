"""Our scores of a published model next to the published ones."""

from collections.abc import Mapping
from dataclasses import dataclass
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
class Comparison:
    """Scores next to the published ones.

    Attributes:
        frames: number of frames that were scored.
        scores: by name: "name", "ours", "published" and "difference", each None if not measured or not published.
        notes: why the numbers may differ, and known mistakes whose pattern they have.
    """

    frames: int
    scores: Mapping[str, Mapping[str, Any]]
    notes: tuple[str, ...]

    def table(self) -> str:
        """The scores as text for a terminal."""
        rows = [f"{'score':9} {'ours':>7} {'published':>10} {'difference':>11}"]
        for name, score in self.scores.items():
            unit = SCORES[name][1] if name in SCORES else "%"
            ours, published, difference = (
                _number(score[key], unit, sign) for key, sign in (("ours", ""), ("published", ""), ("difference", "+"))
            )
            rows.append(f"{f'{name} {unit}'.strip():9} {ours:>7} {published:>10} {difference:>11}")
        return "\n".join(rows)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"frames": self.frames, "scores": self.scores, "notes": list(self.notes)}


def _number(value: float | None, unit: str, sign: str) -> str:
    scale, digits = (100, 1) if unit == "%" else (1, 3)
    return "–" if value is None else f"{scale * value:{sign}.{digits}f}"


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
    others = [name for name in published if name not in SCORES]
    scores = {name: _pair(name, ours[key], published.get(name)) for name, (key, _) in SCORES.items()}
    scores |= {name: _pair(name, None, published[name]) for name in others}
    notes = []
    if metrics["frames"] != VALIDATION_FRAMES:
        notes.append(
            f"the published scores are those of the {VALIDATION_FRAMES:,} frames of the validation split, these of "
            f"{metrics['frames']:,}: they need not agree"
        )
    if others:
        notes.append(f"{', '.join(others)}: not measured here; `bevcli eval --tracking` scores tracks")
    notes += known_mistakes(metrics, temporal=temporal)
    return Comparison(metrics["frames"], scores, tuple(notes))


def _pair(name: str, ours: float | None, published: float | None) -> dict[str, Any]:
    difference = None if ours is None or published is None else ours - published
    return {"name": name, "ours": ours, "published": published, "difference": difference}
