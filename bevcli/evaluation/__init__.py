"""Scores of predictions: the nuScenes detection metrics, and IoU of BEV maps.

The entry point:
    evaluate            reads predictions and ground truth, scores them; the result is printed, stored or plotted

Input:
    inputs              predictions and ground truth from files, folders or a nuScenes root
    submission          results_nusc.json, read and written
    pairing             which frames of the two belong together, and their boxes in one frame of reference

Metrics; they read no files:
    config              all parameters of the detection score
    detection           boxes of many frames -> AP, mAP, true-positive errors, NDS
    detection_scores    the result of `detection`
    scored_boxes        the boxes of many frames as one array
    matching            greedy matching of predictions and ground truth, the devkit's rule
    precision_recall    precision and errors as functions of recall
    segmentation        IoU of BEV maps
    joint               scores of several drives together, from the matching of each

Output:
    scores_report       scores as a dict for JSON and as a table for the terminal
    plots               precision and recall, errors by range
    bev_sheet           missed ground truth and false positives seen from above
    export_csv, export_kitti    boxes in the formats of other tools
"""
