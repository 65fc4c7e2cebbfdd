"""Reads recordings and shows them: what `bevcli viz` does.

recording_file     checks a file, repairs a copy of one that was cut off, and shows one in a notebook
recording_reader   reads a recording frame by frame, its boxes, and its summary
video              a video of all cameras and the BEV
native, web        the viewer in a window, for a screenshot and in the browser, also while a recording is written
"""
