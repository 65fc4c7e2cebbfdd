"""From a Sequence to Predictions, frame by frame."""
