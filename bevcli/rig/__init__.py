"""Diagnosis of a calibration: what is wrong with a camera rig, and drawings that show it.

The entry point:
    check_calibration    reads a calibration or a sequence, runs all checks; the result is written, printed, or used

Checks; each yields findings (`bevcli.findings`):
    rig_report           all checks of a rig in their order, the findings that suppress others, the terminal's text
    pose_checks          camera poses: units, inverted transforms, quaternion order, axes, and against camera names
    lens_checks          intrinsics, image sizes, lens distortion
    bev_checks           the bev frame that the weights expect
    coverage             the cameras that see each cell of the BEV grid; the rig next to nuScenes'
    sequence_checks      ego-motion and camera timestamps

Geometry that they share:
    mounting             position, angles, field of view and horizon of a camera

Outputs:
    overlay              a camera's image with pillars, ground grid and horizon
    drawings             cameras.png and coverage.png
    rig_recording        recording.rrd, for the rerun viewer
"""
