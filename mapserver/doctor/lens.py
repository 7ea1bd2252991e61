"""The lens of the calibration against the images: whether another lens fits them far better."""

from collections.abc import Callable

import numpy as np

from fleetmap.recordings import Recording
from fleetmap.sensors.lens_fit import DOUBTFUL_RATIO, FITS_PX2, lens_of_frames
from fleetmap.sensors.samples import CameraFrame
from mapserver.doctor.findings import Finding, Limits, judge, not_judged

NAME = "lens"
_LIMITS = Limits(DOUBTFUL_RATIO, 2.5, "times the squared error of the best other lens")


def lens_check(recording: Recording, read: Callable[[int], CameraFrame | None]) -> Finding:
    """Compares the given lens with other ones. read: a frame of the recording, None for a damaged one."""
    fit = lens_of_frames(recording.calibration, recording.frame_stamps_ns, read)
    if fit is None:
        reason = "too few points were followed from frame to frame, or hardly moved"
        return not_judged(NAME, reason, "drive, with a pair or depth")
    if fit.best_px2 > FITS_PX2:
        return not_judged(
            NAME, f"no lens fits the points (error {np.sqrt(fit.best_px2):.1f} px)", "drive, with every frame"
        )
    words = fit.words(recording.calibration.cameras[0])
    return judge(NAME, fit.ratio, _LIMITS, words, words)
