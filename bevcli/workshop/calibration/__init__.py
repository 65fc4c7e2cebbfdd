"""A calibration that is measured from the drive itself.

The entry point:
    calibrate            reads a drive, measures, judges; the result is printed, written, used, or turned into findings

In the order of the work:
    views                the frame pairs that are used, and their grey images
    matches              points that a camera sees in both frames of a pair
    unknowns             what is estimated: one vector, and the geometry that follows from it
    residuals            matched points and road points against that geometry
    solve                robust least squares
    road                 the road in both frames of a pair: heights of the cameras, roughly, and points
    levels               whether a camera has measured its height from a pavement
    measure              all of it in rounds, and the images and matches that show it

Outputs:
    estimates            what is said about each camera and the whole rig, with the text for the terminal
    result               the corrected rig, the drive with it, and the files
    drawings             calibration.png and recording.rrd
"""
