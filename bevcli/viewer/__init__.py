"""Reads recordings and shows them: what `bevcli viz` does.

recording_file     checks a file, and repairs a copy of one that was cut off
recording_reader   reads a recording frame by frame; the base of all that follows
summary            frames, time span, boxes per class, sizes
export             the shown boxes as .csv or .json
video              a video of all cameras and the BEV; `video_frame` draws a frame with `flat_drawing`
screenshot         an image of the viewer, without a screen
native, web        the viewer in a window, and in the browser
live               a viewer that follows a recording while it is written
"""
