"""The same drives with corrupted images, calibration, times and ego-motion, scored one by one.

In the order of a test: `corruptions` (of images), `sequences` (which apply them, and other faults), `conditions` (all
corruptions with their severities), `results` (stress.json), `report`, `stress` (the entry point).
"""
