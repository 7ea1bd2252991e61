"""What pictures of the simulator do to an estimator's measurements, as numbers.

Measured by `python tests/benchmarks/measure_statistics.py` on `small-loop` (survey by day; tote by day and night, the next
day's stock). Figures in the comments are that command's.
"""

from fleetmap.config import Section

PITCH_PX = 9.5  # a corner of a given extent is found up to the distance at which it spans so many pixels


class FlowStatistics(Section, frozen=True):
    """Corners followed by optical flow.

    White noise and a slow error that is independent after slow_frames: together they give the errors of tracks after 1, 2,
    4, 8 and 16 frames: 0.09 0.13 0.21 0.36 0.71 px.
    slip_*: the share that slides along edges; 3 % are more than 2 px off after one frame, 11 % after 8.
    """

    white_px: float = 0.05
    slow_px: float = 0.58
    slow_frames: float = 16.0
    slip_share: float = 0.10
    slip_px: float = 4.0
    lost_share: float = 0.055
    disparity_known_share: float = 0.82
    disparity_px: float = 0.075
    disparity_wrong_share: float = 0.018
    disparity_wrong_px: float = 10.0
    most_points: int = 180


class FeatureStatistics(Section, frozen=True):
    """Features found by a detector and their descriptors.

    corner_px: at the octave's own scale; two pictures differ by 0.78 px. A landmark is found in a picture with found_share,
    provided that it can be found from that direction, which holds for view_share of the directions (in steps of
    view_step_rad); `count` is filled up with clutter that shows in no other picture. Found again: 0.66 after 0.25 m, 0.57
    after 1 m, 0.45 by a lower camera on the next day, when an eighth of the stock is new. Bits apart, of 256: median 41
    (10..90 %: 23..69), 49, 56; noise_bits are the mean of one picture, view_bits those of one direction's step.
    dirt_bits between two cartons of one kind is an assumption.
    """

    count: int = 1000
    found_share: float = 0.70
    view_share: float = 0.80
    corner_px: float = 0.55
    octave_sigma: float = 0.54
    disparity_known_share: float = 0.83
    disparity_px: float = 0.1
    disparity_wrong_share: float = 0.018
    disparity_wrong_px: float = 10.0
    dirt_bits: int = 14
    view_bits: int = 8
    view_step_rad: float = 0.2
    noise_bits: float = 20.0
