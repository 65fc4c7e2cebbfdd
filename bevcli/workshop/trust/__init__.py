"""Does it work on my cameras: a score without labels, and faults that show without them.

In the order of the work:
    figures       numbers of a run's boxes that need no labels
    fit, fits/    how the figures of known weights go with their true NDS
    estimate      the entry point: the estimated score of a drive, or of the files of a run
    camera_faults faults of single cameras, by how points move in their images
    faults        all faults that show without labels
"""
