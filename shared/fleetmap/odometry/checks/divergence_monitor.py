"""When an IMU, or a filter that began with it, is no longer believed: frame after frame the pictures show something else."""

import numpy as np

from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse

_DISAGREEMENT_RAD = 0.02  # between the turn that pictures show from one frame to the next and the gyro's
_MOST_DISAGREEMENTS = 8  # frames that disagree beyond those that agree, before the IMU is no longer believed
_MOST_OFFSET_SIGMAS = 3.0  # between the clocks, beyond which it is not the clocks
_STRAYED_M, _MOST_STRAYED = 0.5, 3  # from what the pictures show of one step, and for so many frames in a row


class DivergenceMonitor:
    """Counts what speaks against the IMU and against the filter. Motions are cam_from_previous (4, 4), None where unknown."""

    def __init__(self, offset_sigma_s: float) -> None:
        """offset_sigma_s: of the time between the two clocks before anything was seen."""
        self._most_offset_s = _MOST_OFFSET_SIGMAS * offset_sigma_s
        self._disagreements = 0
        self._strayed = 0

    def is_wrong_imu(self, predicted: Array | None, seen: Array | None) -> bool:
        """Whether pictures have turned otherwise than the gyro too often, this frame counted in.

        Such an IMU belongs to another recording, or is mounted otherwise than calibrated.
        """
        if predicted is None or seen is None:
            return False
        off_rad = rotation_angle_rad(predicted[:3, :3].T @ seen[:3, :3])
        self._disagreements = max(self._disagreements + (1 if off_rad > _DISAGREEMENT_RAD else -1), 0)
        return self._disagreements >= _MOST_DISAGREEMENTS

    def is_wrong_start(self, offset_s: float, predicted: Array | None, seen: Array | None) -> bool:
        """Whether the filter must begin again, this frame counted in.

        A start that took an even acceleration for rest is tilted by degrees. The filter then explains what it sees by clocks
        that are further apart than they can be; or it strays from the pictures, frame after frame.
        """
        if abs(offset_s) > self._most_offset_s:
            return True
        if predicted is None or seen is None:
            return False
        off_m = float(np.linalg.norm((predicted @ se3_inverse(seen))[:3, 3]))
        self._strayed = 0 if off_m < _STRAYED_M else self._strayed + 1
        return self._strayed >= _MOST_STRAYED

    def begin_again(self) -> None:
        """Another filter, which has not strayed yet."""
        self._strayed = 0
