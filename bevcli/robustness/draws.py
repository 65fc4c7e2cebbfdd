"""Random numbers that depend on a seed and on names only, not on the order in which frames are read."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Draws:
    """The random numbers of one corruption.

    The severity is no part of the key: a harder severity draws the same numbers as an easier one, so that, for example,
    it loses the same images and more.

    Attributes:
        seed: of the whole test, 0 or greater.
        corruption: the name of the corruption.
    """

    seed: int
    corruption: str

    def generator(self, *keys: str | int) -> np.random.Generator:
        """A generator for what the keys name, such as scene, frame index and camera."""
        digest = hashlib.sha256("\0".join(map(str, (self.corruption, *keys))).encode()).digest()
        return np.random.default_rng([self.seed, *np.frombuffer(digest, dtype="<u4").tolist()])
