"""Thousands of drives: distributes drives to workers, each of which runs a drive as `bevcli run` does.

In the order of a batch:

    storage             folders on this machine and in object stores (fsspec URLs)
    nuscenes_url        nuScenes roots in object stores: tables once a machine, images scene by scene
    drives              arguments -> list of drives, each with a hash of its input
    job                 what every drive is run with, and the hash of it
    worker              one drive: fetch, run, score, land its results; attempts are counted
    ray_workers         workers on Ray, on this machine or a cluster
    run_batch           the loop: skips what is done, hands drives to workers, writes the tables
    results             results of drives -> batch.parquet and batch.csv; joint metrics
    report              report.html; `charts` draws its histograms
    embeddings          one vector per frame: pooled BEV features
    find_like           the frames of a batch that are most similar to one frame
"""
