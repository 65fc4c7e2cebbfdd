"""Does it work on my cameras: a score without labels, faults, and the gap of a rig."""
