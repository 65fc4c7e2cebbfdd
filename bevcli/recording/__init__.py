"""Writes frames and predictions into a rerun recording (.rrd).

    record          `record`: a drive with its labels, and boxes of files, without a model
    writer          the class `Recording`: all that is written about a frame, in order; its settings are in `options`
    entities        the entity paths and the colours, shared with the viewer
    blueprint       the layout of the views and the order of the cameras
    log_ground      images and lines of the ground: BEV features, maps, probes, lines of models, futures
    log_cameras     one camera's pose, image and overlays; boxes in its image, with labels
    log_boxes       boxes and ground truth in 3D, from above and on the street map; misses, false positives, trails
    log_static      all that is written once: rig, vehicle, range rings, pillars, legend, the page "About"
    meshes          the default car, and meshes of files, which `mesh_file` reads in a process of its own
    components      the rows of all these as Arrow arrays

`bevcli.viewer` reads and shows recordings; nothing here imports it.
"""
