"""Trajectory of all frames from adjusted keyframes and the motion between them, as odometry or an earlier adjustment knows it."""

import numpy as np

from fleetmap.geometry import Array, interpolate_se3, se3_inverse
from fleetmap.sensors.samples import Stamps


def frame_trajectory(
    frame_stamps_ns: Stamps, odom_from_body: Array, keyframe_frames: list[int], map_from_body: Array
) -> Array:
    """map_from_body (F, 4, 4) of all frames: carried from the keyframe before and from the one after, blended by time.

    odom_from_body (F, 4, 4): the motion; keyframe_frames (K,) frame numbers, rising; map_from_body (K, 4, 4).
    """
    out = np.empty((len(frame_stamps_ns), 4, 4))
    afters = np.searchsorted(keyframe_frames, np.arange(len(out))).tolist()
    for f, after in enumerate(afters):
        if after < len(keyframe_frames) and keyframe_frames[after] == f:
            out[f] = map_from_body[after]
            continue
        sides = [k for k in (after - 1, after) if 0 <= k < len(keyframe_frames)]
        there = [(map_from_body[k], odom_from_body[keyframe_frames[k]]) for k in sides]
        carried = [map_from_k @ se3_inverse(odom_from_k) @ odom_from_body[f] for map_from_k, odom_from_k in there]
        if len(sides) == 1:
            out[f] = carried[0]
            continue
        start, end = (int(frame_stamps_ns[keyframe_frames[k]]) for k in sides)
        out[f] = interpolate_se3(carried[0], carried[1], (int(frame_stamps_ns[f]) - start) / (end - start))
    return out
