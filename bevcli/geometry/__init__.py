"""Pure geometry in NumPy float64. No files are read here.

transforms: rigid transforms, quaternions, poses.
cameras: projection, lens distortion and undistortion; the camera rig; noise on poses.
boxes: 3D boxes in one frame of reference.
bev_grid: cells of the BEV grid in metres, pillar heights.
ego_motion: poses and kinematics of the vehicle over time.
"""
