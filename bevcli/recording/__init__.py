"""Writes frames and predictions into a rerun recording (.rrd).

    writer          the class `Recording`; its settings are in `options`, its file in `rrd_file`
    entities        the entity paths, shared with the viewer
    blueprint       the layout of the views and the order of the cameras
    log_static      all that is written once: rig, vehicle (`vehicle`), range rings, pillars, legend, the page "About"
    log_cameras     one camera's pose, image and overlays; `box_lines` projects boxes and places their labels
    log_boxes       boxes and ground truth in 3D, from above and on the street map; misses and false positives
    log_tracks      a trail for each track
    log_bev         BEV features as images, segmentation, history, probed cells
    components      the rows of all these as Arrow arrays
    colors          the colours of classes and states

`bevcli.viewer` reads and shows recordings; nothing here imports it.
"""
