"""Detection of a wrong IMU and of a diverged filter: both contradict the images for several frames."""

import numpy as np

from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse

_DISAGREEMENT_RAD = 0.02  # between the rotation of one step by images and by gyro
_MAX_DISAGREEMENTS = 8  # frames that disagree beyond those that agree, before the IMU is given up
_MAX_OFFSET_SIGMAS = 3.0  # a larger time offset cannot be one
_DIVERGED_M, _MAX_DIVERGED_FRAMES = 0.5, 3  # from the motion of one step by images, for so many frames in a row


class DivergenceMonitor:
    """Counts disagreements with the images. Motions are cam_from_previous (4, 4), None where unknown."""

    def __init__(self, offset_sigma_s: float) -> None:
        """offset_sigma_s: of the time between the two clocks before anything was seen."""
        self._max_offset_s = _MAX_OFFSET_SIGMAS * offset_sigma_s
        self._disagreements = 0
        self._diverged_frames = 0

    def is_wrong_imu(self, predicted: Array | None, seen: Array | None) -> bool:
        """Whether images and gyro have disagreed on rotation too often, this frame included.

        Such an IMU belongs to another recording, or its mounting differs from the calibration.
        """
        if predicted is None or seen is None:
            return False
        off_rad = rotation_angle_rad(predicted[:3, :3].T @ seen[:3, :3])
        self._disagreements = max(self._disagreements + (1 if off_rad > _DISAGREEMENT_RAD else -1), 0)
        return self._disagreements >= _MAX_DISAGREEMENTS

    def is_wrong_start(self, offset_s: float, predicted: Array | None, seen: Array | None) -> bool:
        """Whether the filter must be initialized again, this frame included.

        A static initialization under constant acceleration is tilted by degrees. The filter then estimates an impossible
        time offset, or its motion differs from that of the images frame after frame.
        """
        if abs(offset_s) > self._max_offset_s:
            return True
        if predicted is None or seen is None:
            return False
        off_m = float(np.linalg.norm((predicted @ se3_inverse(seen))[:3, 3]))
        self._diverged_frames = 0 if off_m < _DIVERGED_M else self._diverged_frames + 1
        return self._diverged_frames >= _MAX_DIVERGED_FRAMES

    def begin_again(self) -> None:
        """Starts the count of diverged frames anew, for a new filter."""
        self._diverged_frames = 0
