"""Readers and writers of single files that several formats and commands share.

boxes_file: ground_truth.json and predictions.json.
incremental_json: a file that only grows, and a JSON file that is written entry by entry.
map_folder: BEV maps, one PNG per frame.
calibration_file: calibration.json.
kalibr_ros: Kalibr and ROS intrinsics that replace calibration.json.
json_fields: checked numbers and rigid transforms in JSON, with findings.
"""
