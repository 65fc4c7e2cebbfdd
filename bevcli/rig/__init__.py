"""Diagnosis of a calibration: what is wrong with a camera rig, and drawings that show it.

check_calibration    reads a calibration or a sequence, runs all checks; the result is written, printed, or used
rig_report           coverage of the BEV grid, the rig next to nuScenes', and the terminal's text
rig_checks           all checks of a rig in their order; lenses and the bev frame
pose_checks          mounting of cameras; units, inverted transforms, quaternion order, axes, camera names
sequence_checks      ego-motion and camera timestamps; the cheap checks before a run
drawings             cameras.png and coverage.png
rig_recording        recording.rrd, for the rerun viewer
"""
