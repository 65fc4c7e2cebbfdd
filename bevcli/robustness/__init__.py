"""The same drives with corrupted images, calibration, times and ego-motion, scored one by one.

stress          the entry point: runs a model under each condition and scores it; interrupted runs go on
conditions      the list of corruptions with their severities
corruptions     corruptions of images; each takes (H, W, 3) uint8 BGR, a level and a random generator
sequences       corruptions as sequences; each wraps a `Sequence` and changes its frames when they are loaded
results         scores by condition, resilience rates and corruption errors; stress.json
report          the table for the terminal, the plot, and one image of every corruption
"""
