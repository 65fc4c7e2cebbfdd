"""Trust in a model on a drive that has no labels: a score without ground truth, and faults that show in its boxes.

In the order of the work:
    figures     numbers of a run's boxes that need no labels
    estimate    the entry point: runs a model over a drive; the estimated score
"""
