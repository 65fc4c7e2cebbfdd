"""Reads recordings and shows them: what `bevcli viz` does.

recording_file     checks a file, repairs a copy of one that was cut off, and shows one in a notebook
recording_reader   reads a recording frame by frame; the base of all that follows
summary            frames, time span, boxes per class, sizes
export             the shown boxes as .csv or .json
video              a video of all cameras and the BEV; `video_frame` draws a frame
screenshot         an image of the viewer, without a screen
native, web        the viewer in a window and in the browser, also while a recording is written
"""
