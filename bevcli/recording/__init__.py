"""Writes frames and predictions into a rerun recording (.rrd).

The class `Recording` is in `writer`, its settings in `options`. What it writes:

    entities        the entity paths, shared with the viewer
    blueprint       the layout of the views; `camera_layout` orders the cameras
    log_static      what is written once: rig, vehicle (`vehicle`), range rings, pillars, the page "About"
    log_cameras     one camera's pose, image and overlays; `box_lines` projects boxes, `labels` places their labels
    log_boxes       boxes and ground truth, in 3D and from above; `matching` finds misses and false positives
    log_bev         BEV features (`bev_images` turns them into images), segmentation, history, probed cells
    colors          the colours of classes and states

`bevcli.viewer` reads and shows recordings; nothing here imports it.
"""
