"""The gap of a rig in `bevcli project-debug`: what differs from the rigs that the weights know, and what it costs.

Measured where the weights were trained on rendered streets, which are those of the package; else by a rule.
"""

import textwrap
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.checkpoints import bundled_weights
from bevcli.config import load_config
from bevcli.errors import InputError
from bevcli.frame import Drive
from bevcli.geometry.cameras import CameraRig
from bevcli.inference.load import load_model
from bevcli.model.config import ModelConfig
from bevcli.printing import aligned, counted
from bevcli.rig.check_calibration import WIDTH, CalibrationCheck, check_calibration
from bevcli.workshop.scores.compare import Difference
from bevcli.workshop.scores.evaluate import finite
from bevcli.workshop.synth.rig import nuscenes_like_rig, rig_for_rendering
from bevcli.workshop.trust.rig_differences import (
    Kind,
    KnownRigs,
    RigDifference,
    known_rigs,
    rig_differences,
    size_differences,
)
from bevcli.workshop.trust.rig_gap import (
    FRAMES,
    STREETS,
    Cost,
    MeasuredRig,
    Scored,
    Shot,
    boxes_of,
    comparable,
    difference,
    is_clear,
    polar_map,
    scored,
    seen_objects,
    sides,
    trial,
)

DARK_GREY = 45  # mean of an image, 0 to 255; those of the rendered streets have 95 to 117
SLOWER = 1.5  # an image rate that is lower by this factor than the model's is a difference


def gap_of_rigs(
    check: CalibrationCheck, model: str, against: Path | None, drive: Drive | None
) -> "MeasuredGap | RuledGap":
    """The gap between a rig, or two, and the rigs that a model's weights know.

    check: of the rig. model: a name or a FILE.toml. against: a calibration or a drive with the second rig. drive: of
    the first one; None for a calibration alone.
    Raises InputError where the second rig has errors, or a rig cannot be rendered.
    """
    config = load_config(model)
    rigs = {check.name: check.rig}
    if against is not None:
        other = check_calibration(against)
        if other.errors:
            raise InputError(
                f"`against={against}` (`--against`): {other.errors[0].line}; `bevcli project-debug {against}` says more"
            )
        rigs[other.name if other.name != check.name else f"{other.name} (second)"] = other.rig
    known, range_m = known_rigs(config), config.bev_grid.nearest_side_m
    found = {name: list(rig_differences(rig, known, range_m)) for name, rig in rigs.items()}
    found[check.name] += () if drive is None else of_drive(drive, config)
    if bundled_weights(model) is None:
        for name, rig in rigs.items():
            found[name] += size_differences(rig, config) if not config.training_rigs.known else ()
        return RuledGap(model, known, {name: tuple(each) for name, each in found.items()})
    return _measured(model, rigs, found, known)


def of_drive(drive: Drive, config: ModelConfig) -> Iterator[RigDifference]:
    """The differences of a drive's images from rendered ones: rate and light."""
    times = np.array([stamp.timestamp_ns for stamp in drive.stamps]) / 1e9
    steps = np.diff(times)[np.diff(times) > 0]
    if len(steps) and (every := float(np.median(steps)) * config.rate_hz) >= SLOWER:
        text = f"{config.rate_hz / every:.2g} images a second of each camera (theirs {config.rate_hz:g})"
        yield RigDifference("rate", (), text, every)
    places = sorted({0, len(times) // 2, len(times) - 1}) if len(times) else []
    greys = [image.pixels_bgr.mean() for place in places for image in drive.load(place).images.values()]
    if greys and (grey := float(np.mean(greys))) < DARK_GREY:
        text = f"dark images: mean grey {grey:.0f} of 255 (theirs 95 to 117); measured with noise"
        yield RigDifference("light", (), text, grey)


@dataclass(frozen=True)
class RuledGap:
    """The differences of rigs from those that weights know, without a measurement.

    Attributes:
        model: its name.
        known: the rigs that its weights know.
        differences: by name of the rig.
    """

    model: str
    known: KnownRigs
    differences: dict[str, tuple[RigDifference, ...]]

    def text(self) -> str:
        whose = self.known.whose.removeprefix("any ")
        head = (
            f"Rig gap: {self.model}, by a rule: angles, heights, fields of view, sizes and blind sectors next to "
            f"those of a {whose}. This is no measurement: what a difference costs these weights is not known."
        )
        lines = textwrap.wrap(head, WIDTH)
        for name, differences in self.differences.items():
            lines += ["", f"{name}: what differs" if differences else f"{name}: nothing differs"]
            lines += [line for each in differences for line in _item(each.kind, each.text)]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        rigs = {name: {"differences": [vars(each) for each in found]} for name, found in self.differences.items()}
        return {"model": self.model, "method": "rule", "rigs": rigs}

    def write(self, folder: Path) -> list[Path]:
        return []


def _item(head: str, text: str) -> list[str]:
    """A row of a list: a short head, and a text that is wrapped beside it."""
    return textwrap.wrap(text, WIDTH, initial_indent=f"  {head:<22} ", subsequent_indent=" " * 25)


@dataclass(frozen=True)
class MeasuredGap:
    """The gap of one or two rigs.

    Attributes:
        model: its name.
        range_m: objects farther away are left out.
        known: the rig that the weights know best.
        rigs: one or two.
    """

    model: str
    range_m: float
    known: MeasuredRig
    rigs: tuple[MeasuredRig, ...]

    @property
    def pairs(self) -> list[tuple[MeasuredRig, MeasuredRig]]:
        """The rigs that are compared: the second against the first."""
        pairs = [(self.known, rig) for rig in self.rigs]
        return pairs + ([self.rigs] if len(self.rigs) == 2 else [])

    def text(self) -> str:
        one = self.known.scored
        where = f"{len(STREETS)} rendered streets, {one.frames} frames"
        where += f", {len(one.places)} objects within {self.range_m:g} m"
        heads = (f"AP {name} ({one.counts[name]})" if name in one.counts else name for name in one.values)
        rows: list[tuple[str, ...]] = [("", *heads, "found"), _row(self.known.name, one)]
        for rig in self.rigs:
            rows.append(_row(rig.name, rig.scored))
            rows += [_row(f"  {cost.label}", cost.shown) for cost in rig.costs if cost.shown is not None]
        rows += [self._differences(a, b) for a, b in self.pairs]
        lines = [
            f"Rig gap: {self.model} on {where}",
            "",
            aligned(rows),
        ]
        for a, b in self.pairs:
            lines += self._sides(a, b)
        for rig in self.rigs:
            head = "what differs, and what it costs (AP of all boxes, with a 95 % interval over the frames)"
            lines += ["", f"{rig.name}: {head if rig.costs else 'nothing differs'}"]
            for cost in rig.costs:
                texts = [each.text for each in cost.differences]
                lines += [line for n, text in enumerate(texts) for line in _item("" if n else cost.text, text)]
        return "\n".join(lines)

    def _differences(self, a: MeasuredRig, b: MeasuredRig) -> tuple[str, ...]:
        cells = [_cell(difference(a.scored, b.scored, column)) for column in a.scored.values]
        before, after = a.scored.found, b.scored.found
        share = f"{after.mean() - before.mean():+.0%}" if is_clear(a.scored, b.scored) else "within noise"
        return f"{b.name} - {a.name}", *cells, share

    def _sides(self, a: MeasuredRig, b: MeasuredRig) -> Iterator[str]:
        clear = sorted(sides(a.scored, b.scored), key=lambda row: row[3] - row[2])
        if clear:
            yield from ("", f"found with {b.name}, and with {a.name}, where the difference is beyond noise")
        for side, count, before, after in clear:
            yield from _item(side, f"{after:.0%} instead of {before:.0%} of {counted(count, 'objects')}")

    def to_dict(self) -> dict[str, Any]:
        differences = [
            {"of": b.name, "against": a.name}
            | {column: difference(a.scored, b.scored, column).to_dict() for column in a.scored.values}
            for a, b in self.pairs
        ]
        one = self.known.scored
        content = {
            "model": self.model,
            "method": "measured",
            "streets": list(STREETS),
            "frames_per_street": FRAMES,
            "objects": len(one.places),
            "objects_by_sector_and_ring": polar_map(one.places, one.found, self.range_m).counts.tolist(),
            "rigs": {each.name: each.to_dict(self.range_m) for each in (self.known, *self.rigs)},
            "differences": differences,
        }
        return {key: finite(value) for key, value in content.items()}

    def write(self, folder: Path) -> list[Path]:
        from bevcli.workshop.trust.rig_gap_picture import write_picture

        path = folder / "rig_gap.png"
        write_picture(path, *self.pairs[-1], self.range_m)
        return [path]


def _row(name: str, one: Scored) -> tuple[str, ...]:
    return name, *(f"{value:.2f}" for value in one.values.values()), f"{one.found.mean():.0%}"


def _cell(each: Difference) -> str:
    low, high = each.interval
    return f"{each.difference:+.2f} ({low:+.2f} to {high:+.2f})" if each.better else "within noise"


def _measured(
    name: str, rigs: dict[str, CameraRig], found: dict[str, list[RigDifference]], known: KnownRigs
) -> MeasuredGap:
    from bevcli.cli.progress import Progress

    for cameras in rigs.values():
        rig_for_rendering(cameras, None)  # names the camera whose lens cannot be rendered
    model, training = load_model(name), nuscenes_like_rig()
    range_m, classes = model.config.bev_grid.nearest_side_m, model.config.object_classes
    kinds: dict[tuple[str, Kind], list[RigDifference]] = defaultdict(list)
    for rig, differences in found.items():
        for each in differences:
            kinds[rig, each.kind].append(each)
    trials = {key: trial(rigs[key[0]], of_kind, known, range_m) for key, of_kind in kinds.items()}
    plain = [Shot(cameras) for cameras in (training, *rigs.values())]
    shots = {shot.path(model): shot for shot in (*plain, *(shot for pair in trials.values() for shot in pair))}
    with Progress(sum(shot.count for shot in shots.values()), "frames of rendered streets") as progress:
        if kept := sum(shot.count for path, shot in shots.items() if path.exists()):
            progress.skip(kept)
        boxes = {path: boxes_of(model, shot, progress.advance) for path, shot in shots.items()}
    seen = seen_objects(*(boxes[shot.path(model)] for shot in plain))
    same_frames = [path for path, shot in shots.items() if shot.frames == FRAMES]
    scores = {path: scored(boxes[path], seen, classes, range_m) for path in same_frames}
    costs: dict[str, list[Cost]] = {rig: [] for rig in rigs}
    for (rig, kind), pair in trials.items():
        both = [scores[shot.path(model)] for shot in pair if kind != "rate"]
        if kind == "rate":
            thinned = comparable(*((shot, boxes[shot.path(model)]) for shot in pair))
            both = [scored(each, seen_objects(*thinned), classes, range_m) for each in thinned]
        costs[rig].append(Cost(tuple(kinds[rig, kind]), *both))
    first, *own = (scores[shot.path(model)] for shot in plain)
    measured = zip(rigs.items(), own, strict=True)
    of_rigs = tuple(MeasuredRig(rig, cameras, each, tuple(costs[rig])) for (rig, cameras), each in measured)
    return MeasuredGap(name, range_m, MeasuredRig("training rig", training, first), of_rigs)
