"""Calibration from recordings: a rig's parameters with their covariance, or the motion needed to observe them."""

from mapserver.calibration.estimate import CalibrationEstimate, ParameterEstimate
from mapserver.calibration.parameters import CalibrationParameter
from mapserver.calibration.recordings import estimate_calibration, stretches

__all__ = ["CalibrationEstimate", "CalibrationParameter", "ParameterEstimate", "estimate_calibration", "stretches"]
