"""Does it work on my cameras: a score without labels, faults that show without them, and the gap of a rig.

In the order of the work:
    figures       numbers of a run's boxes that need no labels
    fit, fits/    how the figures of known weights go with their true NDS
    estimate      the entry point: the estimated score of a drive, or of the files of a run
    camera_faults faults of single cameras, by how points move in their images
    faults        all faults that show without labels
    rig_differences, rig_gap, rig_gap_picture, gap_option: what a rig costs, for `bevcli project-debug --model`
"""
