"""Trust in a model on a drive that has no labels: a score without ground truth, and faults that show in its boxes.

In the order of the work:
    figures       numbers of a run's boxes that need no labels
    fit, fits/    how the figures of known weights go with their true NDS
    estimate      the entry point: the estimated score of a drive, or of the files of a run
    run_option    the option `score_without_labels` of `bevcli run`
"""
