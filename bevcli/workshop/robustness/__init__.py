"""The same drives with corrupted images, calibration, times and ego-motion, scored one by one.

In the order of a test: `conditions` (all corruptions with their severities, and the sequences that apply them),
`stress` (the entry point, stress.json and the table).
"""
