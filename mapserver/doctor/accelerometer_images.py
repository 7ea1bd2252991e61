"""The accelerometer against the images: signs and order of its axes, and the metric scale of the images.

Positions of the body at times t0, t1 and t2 give a change of velocity, (p2 - p1) / (t2 - t1) - (p1 - p0) / (t1 - t0). It is the
integral of the acceleration with a weight that rises from 0 at t0 to 1 at t1 and falls to 0 at t2, for any velocity. The same integral of
the specific force, rotated by the images, is that change in true metres, plus gravity, plus the accelerometer's bias.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, so3_exp
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

    @property
    def is_reversed(self) -> bool:
        """True if all axes have the wrong sign."""
        return bool((self.body_from_accel == -np.eye(3)).all())


def fit_accelerometer(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> list[AxesFit]:
    """Return all possible orders and signs of the axes, the best first; empty with too few images."""
    windows = _windows(turns, imu, imu_minus_cam_s)
    if len(windows) < _MIN_WINDOWS:
        return []
    changes, forces, biases, runs, spans_s = (np.array(column) for column in zip(*windows, strict=True))
    # metres, bias, gravity in the axes at the start of each run of frames
    design = np.zeros((len(windows), 3, 7 + 3 * int(runs.max())))
    design[:, :, 0], design[:, :, 1:4] = changes, biases
    for axis in range(3):
        design[np.arange(len(windows)), axis, 4 + 3 * runs + axis] = spans_s
    held = np.zeros((3, design.shape[2]))
    held[:, 1:4] = np.eye(3) * _NOISE_MPS / _BIAS_SIGMA_MPS2
    fits: list[AxesFit] = []
    kept = np.ones(len(windows), bool)
    for _ in range(2):  # the second time without outliers of the best
        rows = np.concatenate([design[kept].reshape(-1, design.shape[2]), held])
        inverse, freedom = np.linalg.pinv(rows), max(len(rows) - design.shape[2], 1)
        fits, least = [], np.inf
        for axes in SIGNED_AXES:
            seen = np.einsum("krab,ab->kr", forces, axes)
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
        likely = max(possible, key=lambda fit: 0.5 if fit.is_reversed else float(np.trace(fit.body_from_accel)))
        words = f"the accelerometer {axes_in_words(likely.body_from_accel)}: that fits the accelerations of the images"
    if given is not None:
        words += f"; as given, up is {np.round(given, 1) + 0.0} of the base"
    words += "; correct its driver's signs, or T_cam_imu in the calibration"
    return Finding(NAME, Verdict.FAIL, None, limit, words)


class _Window(NamedTuple):
    """One change of velocity: by the images (3,); by the specific force, (3, 3, 3) to be summed with body_from_accel over the last two;
    the effect of a bias on that (3, 3); run: number of the run of frames; span_s: factor of gravity in it."""

    change: Array
    force: Array
    bias: Array
    run: int
    span_s: float


def _windows(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> list[_Window]:
    """Return the windows of all runs of consecutive frames, in the axes of the body at the start of their run."""
    known = np.isfinite(turns.ways_m).all(axis=1)
    if len(imu) < 10 or known.sum() < 2:
        return []
    turns = turns.only(np.flatnonzero(known))
    origin_ns = int(turns.starts_ns[0])
    starts_s, ends_s = (turns.starts_ns - origin_ns) * 1e-9, (turns.ends_ns - origin_ns) * 1e-9
    times_s = (imu.stamps_ns - origin_ns) * 1e-9 - imu_minus_cam_s
    steps = max(1, round(_HALF_WINDOW_S / float(np.median(ends_s - starts_s))))
    broken = np.flatnonzero(turns.starts_ns[1:] != turns.ends_ns[:-1]) + 1
    windows: list[_Window] = []
    run = 0
    for first, end in zip([0, *broken], [*broken, len(starts_s)], strict=True):
        if end - first < 2 * steps:
            continue
        places, rotations = [np.zeros(3)], [np.eye(3)]
        for k in range(first, end):
            places.append(places[-1] + rotations[-1] @ turns.ways_m[k])
            rotations.append(rotations[-1] @ so3_exp(turns.rates_body_radps[k] * (ends_s[k] - starts_s[k])))
        at_s = np.append(starts_s[first:end], ends_s[end - 1])
        for k in range(0, end - first - 2 * steps + 1, steps):
            t0, t1, t2 = at_s[[k, k + steps, k + 2 * steps]]
            inside = np.flatnonzero((times_s > t0) & (times_s < t2))
            if len(inside) < 4 or np.diff(times_s[inside]).max() > 0.25 * _HALF_WINDOW_S:
                continue
            p0, p1, p2 = places[k], places[k + steps], places[k + 2 * steps]
            t = times_s[inside]
            weights = np.minimum((t - t0) / (t1 - t0), (t2 - t) / (t2 - t1))
            weights *= 0.5 * (t2 - t0) / weights.sum()
            number = np.clip(np.searchsorted(at_s, t) - 1, 0, end - first - 1)
            vectors = turns.rates_body_radps[first + number] * (t - at_s[number])[:, None]
            turned = np.array([rotations[n] @ so3_exp(vector) for n, vector in zip(number, vectors, strict=True)])
            weighted = weights[:, None, None] * turned
            force = np.einsum("iab,ic->abc", weighted, imu.accel_mps2[inside])
            change = (p2 - p1) / (t2 - t1) - (p1 - p0) / (t1 - t0)
            windows.append(_Window(change, force, weighted.sum(axis=0), run, 0.5 * (t2 - t0)))
        run += 1
    return windows
