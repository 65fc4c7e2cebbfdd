"""From a drive to Predictions."""
