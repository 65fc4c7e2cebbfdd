"""Diagnosis of a calibration: what is wrong with a camera rig, and drawings that show it.

The entry point:
    check_calibration    reads a calibration or a sequence, runs all checks; the result is written, printed, or used
    inputs               reads what is checked: the rig, its images and, of a sequence folder, ego-motion and timestamps

Checks; each yields findings (`bevcli.findings`):
    rig_report           all checks of a rig in their order, and which findings suppress others
    pose_checks          camera poses: units, inverted transforms, quaternion order, axes
    name_checks          camera names against poses: swapped names, copied poses, a turned ego frame
    lens_checks          intrinsics, image sizes, lens distortion
    bev_checks           the bev frame that the weights expect
    coverage             how many cameras see each cell of the BEV grid
    nuscenes_comparison  height, pitch, roll, field of view and overlap next to nuScenes'
    sequence_checks      ego-motion and camera timestamps

Geometry that they share:
    mounting             how a camera is mounted: position, angles, field of view, horizon

Outputs:
    report_text          the text for the terminal
    overlay              a camera's image with pillars, ground grid and horizon
    camera_sheet         cameras.png: all overlays, arranged around the vehicle
    coverage_map         coverage.png
    rig_recording        recording.rrd, for the rerun viewer
"""
