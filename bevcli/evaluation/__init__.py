"""Scores of predictions: the nuScenes detection metrics, and IoU of BEV maps.

    evaluate            the entry point: reads predictions and ground truth, scores them; dict for JSON, and tables
    scorers             scores of further results, such as tracks, which other packages register

Input:
    inputs              predictions and ground truth from files, folders or a nuScenes root, and pairs of their frames

Metrics; they read no files:
    config              all parameters of the detection score
    detection           boxes of many frames -> AP, mAP, true-positive errors, NDS
    matching            the boxes of many frames as one array, and their greedy matching, the devkit's rule

Output:
    box_format          formats that boxes are exported in
    submission          nuScenes submissions, which are read too
"""
