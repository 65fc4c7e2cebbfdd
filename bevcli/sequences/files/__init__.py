"""Readers and writers of single files that several formats and commands share.

calibration_file: the rig, of calibration.json; of calibrations of other programs by their readers.
ego_motion_file: the vehicle's poses, of ego_motion.csv; other files are handed over to what is registered for them.
boxes_file: ground_truth.json and predictions.json, and the class names of data sets.
map_folder: BEV maps, one PNG per frame.
incremental_json: a file that only grows, and a JSON file that is written entry by entry.
json_fields: checked numbers and rigid transforms in JSON, with findings.
"""
