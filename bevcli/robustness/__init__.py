"""How robust a model is: the same drives with corrupted images, calibration, times and ego-motion, scored one by one.

The entry point:
    stress              runs a model under each condition and scores it; interrupted runs go on

Corruptions of images; each takes (H, W, 3) uint8 BGR, a level and a random generator:
    lighting            brightness, low light
    processing          motion blur, colour quantisation
    weather             fog, snow

Corruptions as sequences; each wraps a `Sequence` and changes its frames when they are loaded:
    sequences           the base class, image corruptions, kept frames, single scenes, lower frame rates
    lost_images         camera crash, lost frames
    calibration_noise   noise on the extrinsics
    ego_motion_faults   wrong capture times, lost ego-motion

What they share, and the output:
    draws               random numbers that depend on the seed and on names only
    conditions          the list of corruptions with their severities
    results             scores by condition, resilience rates and corruption errors; stress.json
    stress_files        the state for --resume, stress.json and the figures
    report              the table for the terminal and the plot
    contact_sheet       one image of every corruption
"""
