"""Does it work on my cameras: agreement with a second witness, and faults that show without labels.

In the order of the work:
    witness       a detector in the images, which knows nothing of the model; also decides what a file of labels means
    sightings     projected boxes and those that it sees, and which are partners
    agreement     the score, its parts and its interval
    estimate      the entry point: the agreement of a model, a run or a file
    camera_faults faults of single cameras, by how points move in their images
    faults        all faults that show without labels
"""
