"""How well a draft's tiles serve a robot, measured before anyone drives with them. Pure.

Frames that the build did not use, or that an earlier version was made of, are localised in the tiles as robots download them. The
matching and the solver are the survey's, not the robot's: one frame at a time from a rough prior, without odometry, filter or
confirmation over several frames. A robot does better with the same tiles; what fails here is a fault of the map.
"""
