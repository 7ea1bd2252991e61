"""The accelerometer against the images: signs and order of its axes, and the metric scale of the images.

Of the changes of velocity that robots see too (`fleetmap.odometry.accelerometer_check`), and with the metres as a further unknown.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fleetmap.geometry import Array, so3_exp
from fleetmap.odometry.accelerometer_check import Posed, change_of_velocity
from fleetmap.sensors.axes import SIGNED_AXES, axes_in_words
from fleetmap.sensors.samples import ImuSamples
from mapserver.doctor.camera_motion import CameraTurns
from mapserver.doctor.findings import Finding, Verdict, not_judged

NAME = "accelerometer axes"
_HALF_WINDOW_S = 0.3
_MIN_WINDOWS = 8
_BIAS_SIGMA_MPS2 = 0.3
_NOISE_MPS = 0.03  # of a change of velocity by the images: weights the bias prior; the windows estimate their own
_FLOOR_MPS = 0.02  # of the same: half a degree of tilt by the images. A smaller scatter is not trusted
_REACH = 4.0  # in typical deviations; windows beyond are outliers, such as people in the picture
# Margin by which the best order of axes must fit better to exclude another: in squares of the windows' scatter, and as a factor.
_SURE_SQUARES, _SURE_RATIO = 40.0, 2.0
_SURE_SIGMAS = 5.0
_UPRIGHT = 0.7  # cosine of the angle between the base's up and the accelerometer's: ramps are far within


@dataclass(frozen=True, slots=True)
class AxesFit:
    """Fit of the images under one order and sign of the axes.

    body_from_accel: signed permutation (3, 3). squares: residual sum of squares. metres, sigma: true metres in one of the images.
    up_body (3,): unit vector against gravity, in the body's axes at the first frame.
    """

    body_from_accel: Array
    squares: float
    metres: float
    sigma: float
    up_body: Array

    @property
    def is_given(self) -> bool:
        """True for the axes stated by the recording."""
        return bool((self.body_from_accel == np.eye(3)).all())


def fit_accelerometer(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> list[AxesFit]:
    """Return all possible orders and signs of the axes, the best first; empty with too few images."""
    windows = _windows(turns, imu, imu_minus_cam_s)
    if len(windows) < _MIN_WINDOWS:
        return []
    rows, runs = (np.array(column) for column in zip(*windows, strict=True))
    forces = rows[:, :, :9]
    # metres, bias, gravity in the axes at the start of each run of frames
    design = np.zeros((len(windows), 3, 7 + 3 * int(runs.max())))
    design[:, :, 0], design[:, :, 1:4] = rows[:, :, 15], -rows[:, :, 9:12]
    for number, run in enumerate(runs):
        design[number, :, 4 + 3 * run : 7 + 3 * run] = -rows[number, :, 12:15]
    held = np.zeros((3, design.shape[2]))
    held[:, 1:4] = np.eye(3) * _NOISE_MPS / _BIAS_SIGMA_MPS2
    fits: list[AxesFit] = []
    kept = np.ones(len(windows), bool)
    for _ in range(2):  # the second time without outliers of the best
        whole = np.concatenate([design[kept].reshape(-1, design.shape[2]), held])
        inverse, freedom = np.linalg.pinv(whole), max(len(whole) - design.shape[2], 1)
        fits, least = [], np.inf
        for axes in SIGNED_AXES:
            seen = forces @ axes.ravel()
            unknowns = inverse @ np.append(seen[kept].ravel(), np.zeros(3))
            off = seen - design @ unknowns
            squares = float((off[kept] ** 2).sum())
            scatter = max(squares / freedom, _FLOOR_MPS**2)
            sigma = float(np.sqrt(scatter * (inverse[0] @ inverse[0])))
            up = unknowns[4:7] / max(float(np.linalg.norm(unknowns[4:7])), 1e-9)
            if squares < least:
                least, reach = squares, np.linalg.norm(off, axis=1)
            if unknowns[0] > -_SURE_SIGMAS * sigma:  # the scale of the images must be positive
                fits.append(AxesFit(axes, squares, float(unknowns[0]), sigma, up))
        kept = reach <= _REACH * max(float(np.median(reach)), 1e-9)
    limit = max(least + _SURE_SQUARES * max(least / freedom, _FLOOR_MPS**2), _SURE_RATIO * least)
    return sorted((fit for fit in fits if fit.squares <= limit), key=lambda fit: fit.squares)


def accelerometer_axes(fits: list[AxesFit], base_from_body: Array | None) -> Finding:
    """Judge the given axes. base_from_body (4, 4): for a robot upright on its wheels, None if it need not be upright."""
    limit = "fail if other signs or another order of the axes fit the images, and the given ones do not"
    if not fits:
        reason = "too few consecutive frames, or frames without metric scale"
        return not_judged(NAME, reason, "record every frame of a pair")
    ups = [None if base_from_body is None else base_from_body[:3, :3] @ fit.up_body for fit in fits]
    possible = [fit for fit, up in zip(fits, ups, strict=True) if up is None or up[2] > _UPRIGHT]
    if any(fit.is_given for fit in possible):
        return Finding(NAME, Verdict.OK, None, limit, "the accelerations of images and accelerometer agree")
    given = next((up for fit, up in zip(fits, ups, strict=True) if fit.is_given), None)
    if not possible:
        words = "no order of the accelerometer's axes lets a robot on wheels stand upright"
    else:
        # All axes reversed is one fault, a driver that reports gravity; it is likelier than two or three wrong axes.
        is_reversed = [(fit.body_from_accel == -np.eye(3)).all() for fit in possible]
        likelihoods = np.where(is_reversed, 0.5, [np.trace(fit.body_from_accel) for fit in possible])
        likely = possible[likelihoods.argmax()]
        words = f"the accelerometer {axes_in_words(likely.body_from_accel)}: that fits the accelerations of the images"
    if given is not None:
        words += f"; as given, up is {np.round(given, 1) + 0.0} of the base"
    words += "; correct its driver's signs, or T_cam_imu in the calibration"
    return Finding(NAME, Verdict.FAIL, None, limit, words)


def _windows(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> list[tuple[Array, int]]:
    """Return rows (3, 16) of the changes of velocity in all runs of consecutive frames, each with the number of its run."""
    known = np.isfinite(turns.ways_m).all(axis=1)
    if len(imu) < 10 or known.sum() < 2:
        return []
    rates_radps, ways_m = turns.rates_body_radps[known], turns.ways_m[known]
    starts_ns, ends_ns = (each[known] + round(imu_minus_cam_s * 1e9) for each in (turns.starts_ns, turns.ends_ns))
    spans_s = (ends_ns - starts_ns) * 1e-9
    steps = max(1, round(_HALF_WINDOW_S / float(np.median(spans_s))))
    broken = np.flatnonzero(starts_ns[1:] != ends_ns[:-1]) + 1
    windows: list[tuple[Array, int]] = []
    long = [ends for ends in pairwise([0, *broken, len(starts_ns)]) if ends[1] - ends[0] >= 2 * steps]
    for number, (first, end) in enumerate(long):
        run: list[Posed] = [(int(starts_ns[first]), np.zeros(3), np.eye(3), np.zeros(3))]
        for k in range(first, end):
            _, place, rotation, _ = run[-1]
            turn = rates_radps[k] * spans_s[k]
            run.append((int(ends_ns[k]), place + rotation @ ways_m[k], rotation @ so3_exp(turn), turn))
        for k in range(0, len(run) - 2 * steps, steps):
            rows = change_of_velocity(run[k : k + 2 * steps + 1], steps, imu)
            windows += [] if rows is None else [(rows, number)]
    return windows
