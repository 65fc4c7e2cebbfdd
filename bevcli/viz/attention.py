"""AttentionView: what the model's attention did in one frame, in the terms in which it is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bevcli.geometry.transforms import Array


@dataclass(frozen=True)
class CameraSamples:
    """Where spatial cross-attention looked in one camera's picture.

    pixels: (K, 2) in the picture as it was read (not the network's input), may lie outside of it.
    weights: (K,) attention weights, not negative; over all cameras of a probe they sum to about 1.
    """

    pixels: Array
    weights: Array


@dataclass(frozen=True)
class Probe:
    """One BEV cell that was asked where it looks.

    cell_center: (2,) x, y of its centre in the bev frame, metres. cameras: name -> samples, of the cameras it hits.
    """

    cell_center: Array
    cameras: Mapping[str, CameraSamples]


@dataclass(frozen=True)
class AttentionView:
    """What a frame's attention did, where the model was asked.

    history_weight: (rows, columns) 0 to 1, how much each cell took from the previous BEV map in temporal
    self-attention, rows from the smallest y; None where no history was used. probes: in the order asked for.
    """

    history_weight: Array | None = None
    probes: tuple[Probe, ...] = ()
