"""The images decide between the readings of a rig and of poses.

In the order of the work:
    pairs         two frames between which the vehicle moved: how far matched points are from where a reading puts them,
                  and how high the cameras are above the road
    judge         the reading that the images show, or the question to the user
    stated        what stated poses are where the images contradict them, for `bevcli project-debug`

A reading is taken if its residual is what sound drives have, and those of all others are clearly larger.
"""
