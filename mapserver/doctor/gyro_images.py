"""The gyro against the images: time offset, scale and axes of their rotation rates."""

from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import AnyArray, Array, rotation_angle_rad, rotation_between_vectors
from fleetmap.odometry.gyro_clock import turned_between
from fleetmap.sensors.axes import SIGNED_AXES, axes_in_words, in_axes
from fleetmap.sensors.samples import ImuSamples
from mapserver.doctor.camera_motion import CameraTurns
from mapserver.doctor.findings import Finding, Limits, Verdict, judge, not_judged
from mapserver.doctor.sensors import NO_IMU, median_period_s

OFFSET, SCALE, AXES = "camera-imu time offset", "gyro scale", "gyro axes"
_MIN_PAIRS = 20
_SEARCH_S, _STEP_S = 0.2, 0.002
SAME_OFFSET_S = 0.006  # beyond, two offsets differ: a warning
_LEAST_RATE_RADPS = 0.05
_SURE_CORRELATION = 0.9
_AS_WELL = 0.01  # of the turning: a tenth of it, as an angle
_REACH, _NOISE_RADPS = 4.0, 0.01  # in typical deviations; intervals beyond are outliers, such as people in the picture
_LACK, _LACK_SIGMAS = 0.3, 4.0  # share of the gyro's turns about an axis
_QUIET_RADPS = 0.002  # sigma of slow errors of a gyro, which the differences of its samples do not show
_PARTS, _UNSTEADY_S = 5, 0.02  # stamps of one clock do not drift by half a frame within seconds


@dataclass(frozen=True, slots=True)
class GyroFit:
    """Best fit of gyro to the images' rates: body_from_gyro (3, 3) orthogonal, perhaps a mirror. Scale gyro over images.

    signed: the order and signs of the axes (3, 3) with a similar fit and the least change, None if absent. unseen: as of `_unseen`.
    offsets_s: of stretches of the run that determine it separately, empty if fewer than two do.
    """

    offset_s: float
    body_from_gyro: Array
    scale: float
    correlation: float
    axes_seen: int
    signed: Array | None
    unseen: dict[str, float]
    offsets_s: Array

    @property
    def is_unsteady(self) -> bool:
        """True if the two clocks drift against each other within the run."""
        return len(self.offsets_s) > 1 and float(np.ptp(self.offsets_s)) > _UNSTEADY_S

    @property
    def is_sure(self) -> bool:
        """True if images and gyro agree well enough to correct the calibration by the offset."""
        return self.correlation > _SURE_CORRELATION and not self.is_unsteady


def gyro_check(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> tuple[list[Finding], GyroFit | None]:
    """Return time offset (beyond the calibrated one), scale and axes of the gyro, and the fit; not judged with too little rotation."""
    unknown = _why_not(turns, imu, imu_minus_cam_s)
    if unknown:
        return [not_judged(name, *unknown) for name in (OFFSET, SCALE, AXES)], None
    fit = fit_gyro(turns, imu, imu_minus_cam_s)
    if fit.correlation < 0.6:
        words = f"the images' and the gyro's rates hardly agree (correlation {fit.correlation:.2f} at best)"
        advice = f"{words}; check that the IMU belongs to this camera and that both are stamped by one clock"
        axes = Finding(AXES, Verdict.FAIL, fit.correlation, "fail below correlation 0.6", advice)
        return [axes, *(not_judged(name, words, "check the gyro's axes first") for name in (OFFSET, SCALE))], None
    return [_offset_finding(fit, imu_minus_cam_s), _scale_finding(fit), _axes_finding(fit)], fit


def turn_upside_down(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float, body_from_cam: Array) -> bool | None:
    """True if the images turn as if each were rotated by 180 degrees in its plane, False if as given; None if unknown."""
    if _why_not(turns, imu, imu_minus_cam_s):
        return None
    gyro, seen = _gyro_rates(turns, imu, imu_minus_cam_s), turns.rates_body_radps
    rotated = body_from_cam[:3, :3] @ np.diag([-1.0, -1.0, 1.0]) @ body_from_cam[:3, :3].T
    as_given, as_rotated = correlation(gyro, seen), correlation(gyro @ rotated.T, seen)
    return as_rotated > as_given if max(as_given, as_rotated) > _SURE_CORRELATION else None


def fit_gyro(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> GyroFit:
    """Return the offset (beyond imu_minus_cam_s), rotation or mirror, and scale with the best fit of the gyro to the images' rates.

    First the offset by the magnitudes, which are independent of axes, then the axes by orthogonal Procrustes, then the offset by the
    vectors; then all of it again without the minority of intervals that disagree.
    """
    offsets_s = np.arange(-_SEARCH_S, _SEARCH_S + _STEP_S / 2, _STEP_S)
    all_seen = turns.rates_body_radps
    all_gyro = _gyro_rates(turns, imu, imu_minus_cam_s + offsets_s)
    kept = np.ones(len(all_seen), bool)
    for _ in range(2):
        seen, gyro = all_seen[kept], all_gyro[:, kept]
        speeds = (np.linalg.norm(rates, axis=-1, keepdims=True) for rates in (gyro, seen))
        offset, shared = int(np.argmax(_correlated(*speeds))), _correlated(gyro, seen)
        for _ in range(3):
            body_from_gyro, _ = _axes(shared[offset])
            scores = (shared * body_from_gyro).sum(axis=(1, 2))
            offset = int(np.argmax(scores))
        body_from_gyro, axes_seen = _axes(shared[offset])
        inliers = _inliers(all_seen, all_gyro[offset] @ body_from_gyro.T)
        if inliers.all():
            break
        kept = inliers
    seen, centred = (rates - rates.mean(axis=0) for rates in (seen, gyro[offset]))
    turned = centred @ body_from_gyro.T
    scale = float((turned * turned).sum() / max((turned * seen).sum(), 1e-12))
    most = 2.0 * (float(((turned / scale - seen) ** 2).sum()) + _AS_WELL * float((seen**2).sum()))
    good = [axes for axes in SIGNED_AXES if float(((centred / scale @ axes.T - seen) ** 2).sum()) <= most]
    signed = max(good, key=lambda axes: float(np.trace(axes)), default=None)
    span_s = float(np.median(turns.ends_ns - turns.starts_ns)) * 1e-9
    noise = 0.5 * float(np.diff(imu.gyro_radps, axis=0).var(axis=0).max()) * median_period_s(imu.stamps_ns) / span_s
    # One camera takes ways for turns.
    unseen = _unseen(turned / scale, seen, max(noise, _QUIET_RADPS**2)) if np.isfinite(turns.ways_m).any() else {}
    parts = []
    for part in np.array_split(np.arange(len(all_seen)), _PARTS):
        if len(part) < _MIN_PAIRS or float(np.sqrt(all_seen[part].var(axis=0).sum())) <= _LEAST_RATE_RADPS:
            continue
        shown = (_correlated(all_gyro[:, part], all_seen[part]) * body_from_gyro).sum(axis=(1, 2))
        if shown.max() > _SURE_CORRELATION:
            parts.append(_peak(offsets_s, shown, int(np.argmax(shown))))
    best_s = _peak(offsets_s, scores, offset)
    return GyroFit(best_s, body_from_gyro, scale, float(scores[offset]), axes_seen, signed, unseen, np.array(parts))


def _unseen(gyro: Array, seen: Array, noise: float) -> dict[str, float]:
    """Return by axis of the body how much of the gyro's rates (K, 3) the images' show, where they certainly lack some: two drives along
    one way have the same turns, but not what the ground does to the robot. noise: variance of the gyro's rates."""
    inverse = np.linalg.inv(gyro.T @ gyro + 1e-6 * len(gyro) * noise * np.eye(3))  # also where an axis never turns
    shares, spreads = inverse @ gyro.T @ seen, inverse.diagonal()
    sigmas = np.sqrt(spreads * (seen - gyro @ shares).var(axis=0))
    lacking = 1.0 - len(seen) * spreads * noise - shares.diagonal() > np.maximum(_LACK, _LACK_SIGMAS * sigmas)
    return {axis: float(share) for axis, share, lacks in zip("xyz", shares.diagonal(), lacking, strict=True) if lacks}


def _correlated(gyro: Array, seen: Array) -> Array:
    """Return (D, k, k) at every offset the correlation of each column of the images' (K, k) with each of the gyro's (D, K, k).

    The sum of its products with a rotation (k, k) is the correlation of all columns, with the gyro rotated.
    """
    seen = seen - seen.mean(axis=0)
    squares = np.einsum("dki,dki->d", gyro, gyro) - len(seen) * (gyro.mean(axis=1) ** 2).sum(axis=1)
    sizes = np.sqrt(np.maximum(squares, 0.0) * (seen * seen).sum())
    return np.asarray(seen.T @ gyro / np.maximum(sizes, 1e-12)[:, None, None])


def _inliers(seen: Array, turned: Array) -> Array:
    """Return (K,) mask of the intervals in which gyro and images agree, up to a scale and a bias estimated by medians."""
    squares = (turned * turned).sum(axis=1)
    moving = squares > _LEAST_RATE_RADPS**2
    share = float(np.median((turned * seen).sum(axis=1)[moving] / squares[moving])) if moving.any() else 1.0
    apart = seen - share * turned
    off = np.linalg.norm(apart - np.median(apart, axis=0), axis=1)
    return np.asarray(off <= _REACH * max(float(np.median(off)), _NOISE_RADPS))


def _why_not(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> tuple[str, str] | None:
    """Return the reason why the gyro cannot be judged and the recording needed; None if it can."""
    if len(imu) < 10:
        return NO_IMU
    pairs = len(turns.starts_ns)
    if pairs < _MIN_PAIRS:
        return f"{pairs} pairs of consecutive frames could be compared, {_MIN_PAIRS} are needed", "record every frame"
    rates = turns.rates_body_radps, _gyro_rates(turns, imu, imu_minus_cam_s)
    spreads = [float(np.sqrt(seen.var(axis=0).sum())) for seen in rates]  # an IMU that turns alone: another robot
    if max(spreads) < _LEAST_RATE_RADPS:
        hardly = f"the camera hardly turns (rates vary by {spreads[0]:.3f} rad/s)"
        return hardly, "drive curves, to the left and to the right"
    return None


def _gyro_rates(turns: CameraTurns, imu: ImuSamples, shifts_s: AnyArray | float) -> Array:
    """Return (..., K, 3) mean gyro rates over the intervals, shifted by each of `shifts_s` on the IMU's clock."""
    origin_ns = int(imu.stamps_ns[0])
    between_s = (np.column_stack([turns.starts_ns, turns.ends_ns]) - origin_ns) * 1e-9
    between_s = between_s + np.asarray(shifts_s)[..., None, None]
    turned = turned_between((imu.stamps_ns - origin_ns) * 1e-9, imu.gyro_radps, between_s)
    return np.asarray(turned / np.diff(between_s))


def correlation(first: Array, second: Array) -> float:
    """Return the correlation of columns (N,) or (N, k), each about its mean."""
    a, b = first - first.mean(axis=0), second - second.mean(axis=0)
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12))


def _axes(correlated: Array) -> tuple[Array, int]:
    """Return orthogonal body_from_gyro (3, 3) and the number of axes of common rotation. With an unobserved axis it is a rotation."""
    u, singular, vt = np.linalg.svd(correlated)
    axes_seen = int((singular > 0.03 * singular[0]).sum())
    if axes_seen < 2:  # the smallest rotation that aligns the two axes, or its reverse
        return rotation_between_vectors(vt[0], u[:, 0]), axes_seen
    sign = 1.0 if axes_seen == 3 else float(np.sign(np.linalg.det(u @ vt)))
    return u @ np.diag([1.0, 1.0, sign]) @ vt, axes_seen


def _peak(offsets_s: Array, scores: Array, index: int) -> float:
    if index in (0, len(scores) - 1):
        return float(offsets_s[index])
    before, here, after = scores[index - 1 : index + 2]
    bend = before - 2 * here + after
    return float(offsets_s[index] + (0.5 * (before - after) / bend * _STEP_S if bend < 0 else 0.0))


def _offset_finding(fit: GyroFit, imu_minus_cam_s: float) -> Finding:
    if fit.is_unsteady:
        low_ms, high_ms = 1e3 * fit.offsets_s.min(), 1e3 * fit.offsets_s.max()
        words = (
            f"the IMU's stamps drift against those of the images, from {low_ms:+.0f} to {high_ms:+.0f} ms beyond the calibration: no "
            "timeshift corrects that; stamp both by one clock, each image at its exposure"
        )
        limit = f"fail if it changes by more than {1e3 * _UNSTEADY_S:g} ms"
        return Finding(OFFSET, Verdict.FAIL, float(high_ms - low_ms), limit, words)
    words = f"the IMU's stamps are {fit.offset_s * 1e3:+.1f} ms from the calibration"
    advice = f"set timeshift_cam_imu to {imu_minus_cam_s + fit.offset_s:+.4f} s, or stamp both by one clock"
    return judge(OFFSET, abs(fit.offset_s) * 1e3, Limits(1e3 * SAME_OFFSET_S, 25.0, "ms"), words, f"{words}; {advice}")


def _scale_finding(fit: GyroFit) -> Finding:
    words = f"the gyro turns {fit.scale:.3f} times as fast as the images"
    is_degrees, limits = 40 < fit.scale < 80, Limits(0.1, 0.3, words="warn 0.1, fail 0.3 from 1")
    advice = "it is in degrees per second, multiply it by pi/180"
    advice = advice if is_degrees else "check its unit, and the focal length in the calibration"
    return replace(judge(SCALE, abs(fit.scale - 1), limits, words, f"{words}; {advice}"), value=fit.scale)


def _axes_finding(fit: GyroFit) -> Finding:
    limit = "warn above 4 degrees, fail above 15 degrees"
    about = f"judged about {fit.axes_seen} of 3 axes"
    if fit.signed is not None and np.trace(fit.signed) < 3.0:
        words = f"the gyro {axes_in_words(fit.signed)}: so the images turn, {about}"
        advice = "correct its driver's signs, or T_cam_imu in the calibration"
        return Finding(AXES, Verdict.FAIL, None, limit, f"{words}; {advice}")
    if np.linalg.det(fit.body_from_gyro) < 0:
        axes = in_axes(fit.body_from_gyro)
        words = f"the gyro's axes are mirrored ({axes}); one has the wrong sign or two are exchanged"
        return Finding(AXES, Verdict.FAIL, None, limit, words)
    for axis, share in fit.unseen.items():  # the first one is enough
        words = f"the images show {share:.0%} of what the gyro turns about the body's {axis} axis: it is of another drive, or loose"
        return Finding(AXES, Verdict.FAIL, share, "fail if 30 % are missing for sure", words)
    angle_deg = float(np.degrees(rotation_angle_rad(fit.body_from_gyro)))
    words = f"the gyro's axes are {angle_deg:.1f} degrees from the calibration, {about}"
    bad = f"{words} ({in_axes(fit.body_from_gyro)}); check body_from_cam (T_cam_imu) and how the IMU is mounted"
    return judge(AXES, angle_deg, Limits(4.0, 15.0, "degrees"), words, bad)
