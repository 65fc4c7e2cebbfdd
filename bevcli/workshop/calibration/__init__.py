"""A calibration that is measured from the drive itself.

In the order of the work:
    views                the frame pairs that are used, and their grey images
    adjustment           what is estimated, the geometry that follows from it, residuals, robust least squares
    road                 the road in both frames of a pair: heights of the cameras, roughly, and points
    measure              matched points, and all of it in rounds
    estimates            what is said about each camera and the whole rig, with the text for the terminal
    calibrate            the entry point: reads a drive, measures, judges; the result is printed, written, or used
"""
