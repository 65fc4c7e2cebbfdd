"""Short trainings draw no learning curves."""

import pytest

from bevcli.workshop.training import files


@pytest.fixture(autouse=True)
def no_learning_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than the steps. The fixture `whole` of test_training.py is made before this one."""
    monkeypatch.setattr(files, "draw_learning_curves", lambda loss, validation, path: None)
