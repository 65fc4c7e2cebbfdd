"""Scores of predictions: the nuScenes detection and tracking metrics, and IoU of BEV maps.

    evaluate            the entry point: reads predictions and ground truth, scores them; prints or plots the result

Input:
    inputs              predictions and ground truth from files, folders or a nuScenes root
    pairing             the frames of the two that belong together, and their boxes in one frame of reference

Metrics; they read no files:
    config              all parameters of the detection and the tracking score
    detection           boxes of many frames -> AP, mAP, true-positive errors, NDS
    matching            the boxes of many frames as one array, and their greedy matching, the devkit's rule
    tracking            AMOTA and the numbers that come with it
    segmentation        IoU of BEV maps
    joint               scores of several drives together, from the matching of each
    driving             lines of the map, forecasts and planned paths: `map_lines`, `motion`, `planning`

Output:
    scores_report       scores as a dict for JSON and as tables for the terminal
    plots               precision and recall, errors by range, missed ground truth and false positives from above
    formats             boxes in the formats of other tools; nuScenes submissions are read too
"""
