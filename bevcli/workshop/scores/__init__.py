"""Scores of predictions: the nuScenes metrics of boxes and tracks, IoU of BEV maps, comparison of two models, plots.

evaluate            the entry point: reads predictions and ground truth, scores them; dict for JSON, and tables
inputs              predictions and ground truth from files, folders or a nuScenes root, and pairs of their frames
detection           boxes of many frames -> AP, mAP, true-positive errors, NDS; reads no files
tracking            boxes with identities -> AMOTA and what comes with it; `association` matches them
compare             two models on the same frames; `bootstrap` draws frames for the intervals
worst_frames        the frames with most missed and most invented boxes
tables              a table of scores as text, CSV and LaTeX
record              a drive with its labels, and boxes of models, as a recording
"""
