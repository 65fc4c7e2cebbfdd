"""Learning curves for TensorBoard."""

import importlib.util
import math
from collections.abc import Mapping
from pathlib import Path

from bevcli.errors import BevcliError


def require_tensorboard() -> None:
    """Raise BevcliError where the package tensorboard is not installed."""
    if importlib.util.find_spec("tensorboard") is None:
        raise BevcliError("`log=\"tensorboard\"` needs the package tensorboard: pip install 'bevcli[tensorboard]'")


class TensorBoardLog:
    """Event files in a folder: `tensorboard --logdir FOLDER` draws them, also while the training runs."""

    def __init__(self, folder: Path, done: int) -> None:
        """done: steps done. TensorBoard hides later ones, of an interrupted training."""
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder), purge_step=done + 1 if done else None)

    def add(self, step: int, group: str, numbers: Mapping[str, float]) -> None:
        """Write the finite numbers of a step as curves group/name, to the file at once."""
        for name, value in numbers.items():
            if math.isfinite(value):
                self._writer.add_scalar(f"{group}/{name}", value, step)
        self._writer.flush()
