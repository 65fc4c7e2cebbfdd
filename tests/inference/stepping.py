"""Runs a model over frames of a sequence, as several tests do."""

import torch

from bevcli.inference.runner import Runner, StepOptions
from bevcli.inference.tracking import TrackerConfig

CPU = torch.device("cpu")


def run(model, sequence, places=None, state=None, **options):
    """The predictions at these places, by default all, and the state after them. options: of `StepOptions`.

    The boxes of a model with tracks have its identities.
    """
    tracker = TrackerConfig() if model.config.has_tracks and options.get("temporal", True) else None
    runner = Runner(model, CPU, StepOptions(**options), tracker=tracker)
    places = range(len(sequence.stamps)) if places is None else places
    predictions = []
    for _, prediction, after in runner.run(sequence, places, state):
        predictions.append(prediction)
        state = after
    return predictions, state
