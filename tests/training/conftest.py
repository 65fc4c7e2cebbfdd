"""Short trainings draw no learning curves."""

import pytest

from bevcli.workshop.training import trainer


@pytest.fixture(autouse=True)
def no_learning_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than the steps. The fixture `whole` of test_training.py is made before this one."""
    monkeypatch.setattr(trainer, "draw_learning_curves", lambda loss, validation, path: None)
