"""Measurement of how well a draft's tiles serve a robot, before anyone drives with them. Pure.

Frames that the build did not use, or that an earlier version was made of, are relocalized in the tiles as robots download them, with the
robots' relocalizer and its default settings: one frame at a time, without odometry, filter or confirmation over several frames. A
robot does better with the same tiles; what fails here is a fault of the map.
"""
