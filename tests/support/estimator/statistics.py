"""Statistics of what an estimator measures on the simulator's pictures.

Measured on `small-loop` (survey by day; tote by day and night, the next day's stock), whose true depth and motion tell where each
corner, disparity and feature belongs. Figures in the comments are those of that day.
"""

from typing import NamedTuple

PITCH_PX = 9.5  # a corner of a given extent is found up to the distance at which it spans so many pixels


class FlowStatistics(NamedTuple):
    """Corners followed by optical flow. The tracker's error is white_px plus shares of the way since a corner was begun.

    lag, along, across: mean and rms of the share along the way (corners lag behind: measured -0.003 and -0.0015, rms
    0.021 and 0.020), rms across it (0.0105, 0.0117). slip: along for the slip_share that slides on edges (5 and 95 % of
    the shares: -0.058 and 0.053). floor_*: on the floor reflections hold corners back, by 0.0125 and 0.006, rms 0.032
    and 0.029; the errors of neighbours are not correlated (0.01, 0.03). Of disparities 0.82 are known, rms 0.1 px, 90 %
    within -0.20 and 0.33 px: a share is rough and too large (foreground in the window), another wrong (1.7 % more than
    1.5 px off), for stretch_frames each.
    """

    white_px: float = 0.05
    lag: float = 0.0018
    along: float = 0.018
    across: float = 0.0105
    floor_lag: float = 0.009
    floor_along: float = 0.028
    slip_share: float = 0.12
    slip: float = 0.06
    lost_share: float = 0.055
    stretch_frames: float = 8.0
    disparity_known_share: float = 0.82
    disparity_px: float = 0.08
    disparity_rough_share: float = 0.25
    disparity_rough_px: float = 0.25
    disparity_rough_bias_px: float = 0.08
    disparity_wrong_share: float = 0.02
    disparity_wrong_px: float = 10.0


class FeatureStatistics(NamedTuple):
    """Features found by a detector and their descriptors.

    corner_px, slip_px: rms at the octave's own scale, of a good corner and of the slip_share that sits elsewhere on its
    edge or pattern. Fitted to the localizer's guided matches of rendered pictures, from their true places, against true
    surfaces: 0.15, 0.35, 0.65, 0.81 and 0.90 of them lie within 0.5, 1, 2.5, 4 and 6 pixels. A landmark is found in a picture
    with found_share, provided that it can be found from that direction, which holds for view_share of the directions
    (in steps of view_step_rad in azimuth and elevation); `total` is filled up with clutter that shows in no other
    picture. Found again: 0.66 after 0.25 m, 0.57 after 1 m, 0.45 by a lower camera on the next day, when an eighth of
    the stock is new. Bits apart, of 256, below 80: median 41 (10..90 %: 23..69), 49, 56; noise_bits are the mean of one
    picture, view_bits those of one direction's step. view_share is such that the localizer's fixes have as many inliers
    as on pictures (309 against 312 a fix). dirt_bits between two cartons of one kind is an assumption.
    """

    total: int = 1000
    found_share: float = 0.72
    view_share: float = 0.57
    corner_px: float = 0.42
    slip_share: float = 0.34
    slip_px: float = 2.4
    octave_sigma: float = 0.54
    disparity_known_share: float = 0.83
    disparity_px: float = 0.1
    disparity_wrong_share: float = 0.018
    disparity_wrong_px: float = 10.0
    dirt_bits: int = 14
    view_bits: int = 20
    view_step_rad: float = 0.3
    noise_bits: float = 20.0
