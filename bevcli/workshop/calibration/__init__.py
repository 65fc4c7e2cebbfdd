"""A calibration that is measured from the drive itself.

In the order of the work:
    adjustment           what is estimated, the geometry that follows from it, residuals, robust least squares
    views                the frame pairs that are used, their grey images, matched points
    road                 the road in both frames of a pair: heights of the cameras, roughly, and points
    calibrate            the entry point: reads a drive, measures in rounds, judges each camera and the whole rig
"""
