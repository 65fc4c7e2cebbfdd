"""Formats of other programs: drives, labels and boxes, and `convert`."""
