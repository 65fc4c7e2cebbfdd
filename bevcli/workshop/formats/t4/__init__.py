"""T4 datasets of TIER IV, as Autoware uses them: nuScenes' tables with additions. They are read by `nuscenes`.

format: the format. sequence: T4Sequence, one dataset as a Sequence, and its class names.
"""
