"""What pictures of the simulator do to an estimator's measurements, as numbers.

Measured by `python tests/benchmarks/measure_statistics.py` on `small-loop` (survey by day; tote by day and night, the next
day's stock). Figures in the comments are that command's.
"""

from fleetmap.config import Section

PITCH_PX = 16.0  # a corner of a given extent is found up to the distance at which it spans so many pixels


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
    lost_share: float = 0.07
    disparity_known_share: float = 0.82
    disparity_px: float = 0.075
    disparity_wrong_share: float = 0.018
    disparity_wrong_px: float = 10.0
    most_points: int = 180


class FeatureStatistics(Section, frozen=True):
    """Features found by a detector and their descriptors.

    corner_px: at the octave's own scale. found_share: of landmarks in view in any one picture; the rest of `count` is
    clutter that shows in no other picture. bits: of 256; view_bits change with each view_step_rad of direction.
    """

    count: int = 1000
    found_share: float = 0.75
    corner_px: float = 0.6
    octave_sigma: float = 0.5
    disparity_known_share: float = 0.83
    disparity_px: float = 0.1
    disparity_wrong_share: float = 0.02
    disparity_wrong_px: float = 10.0
    dirt_bits: int = 14
    view_bits: int = 8
    view_step_rad: float = 0.2
    noise_bits: float = 3.0
