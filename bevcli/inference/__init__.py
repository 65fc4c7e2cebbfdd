"""From a Sequence to Predictions."""
