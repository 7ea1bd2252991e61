"""The gyro against the images: time offset, scale and axes of their rotation rates."""

from dataclasses import dataclass, field

import numpy as np

from fleetmap.geometry import Array, rotation_angle_rad, rotation_between_vectors
from fleetmap.sensors.axes import SIGNED_AXES, axes_in_words, in_axes
from fleetmap.sensors.samples import ImuSamples, Stamps
from mapserver.doctor.findings import Finding, Limits, Verdict, judge, not_judged
from mapserver.doctor.timing import RECORD_IMU

_MIN_PAIRS = 20
_SEARCH_S, _STEP_S = 0.2, 0.002
_LEAST_RATE_RADPS = 0.05
_SURE_CORRELATION = 0.9
_AS_WELL = 0.01  # of the turning: a tenth of it, as an angle
AXES = "gyro axes"
_NAMES = ("camera-imu time offset", "gyro scale", AXES)


@dataclass(frozen=True, slots=True)
class CameraTurns:
    """Motion seen by the images. Intervals from starts_ns to ends_ns (K,), rates_body_radps (K, 3) mean in body axes.

    ways_m (K, 3): where the body was at the end, in its axes at the start and the calibration's metres; NaN with one camera, or empty.
    """

    starts_ns: Stamps
    ends_ns: Stamps
    rates_body_radps: Array
    ways_m: Array = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, slots=True)
class GyroFit:
    """What explains the images' rates best: body_from_gyro (3, 3) orthogonal, perhaps a mirror. Scale gyro over images.

    signed: the order and signs of the axes (3, 3) that explain them about as well and change least, None where none does.
    """

    offset_s: float
    body_from_gyro: Array
    scale: float
    correlation: float
    axes_seen: int
    signed: Array | None


def gyro_check(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> tuple[list[Finding], float | None]:
    """Time offset (beyond the calibrated one), scale and axes of the gyro; not judged without turns to judge by.

    With them the offset in seconds, where images and gyro agree well enough to correct the calibration by it.
    """
    unknown = _why_not(turns, imu, imu_minus_cam_s)
    if unknown:
        return [not_judged(name, *unknown) for name in _NAMES], None
    fit = fit_gyro(turns, imu, imu_minus_cam_s)
    if fit.correlation < 0.6:
        words = f"the images' and the gyro's rates hardly agree (correlation {fit.correlation:.2f} at best)"
        advice = "check that the IMU belongs to this camera and that both are stamped by one clock"
        return [
            Finding(AXES, Verdict.FAIL, fit.correlation, "fail below correlation 0.6", f"{words}; {advice}"),
            *(not_judged(name, words, "check the gyro's axes first") for name in _NAMES[:2]),
        ], None
    findings = [_offset_finding(fit, imu_minus_cam_s), _scale_finding(fit), _axes_finding(fit)]
    return findings, fit.offset_s if fit.correlation > _SURE_CORRELATION else None


def turn_upside_down(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float, body_from_cam: Array) -> bool | None:
    """True if the images turn as if each were rotated by 180 degrees in its plane, False if as given; None where nothing tells."""
    if _why_not(turns, imu, imu_minus_cam_s):
        return None
    gyro, seen = _gyro_rates(turns, imu, imu_minus_cam_s), turns.rates_body_radps
    rotated = body_from_cam[:3, :3] @ np.diag([-1.0, -1.0, 1.0]) @ body_from_cam[:3, :3].T
    as_given, as_rotated = _correlation(gyro, seen), _correlation(gyro @ rotated.T, seen)
    return as_rotated > as_given if max(as_given, as_rotated) > _SURE_CORRELATION else None


def fit_gyro(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> GyroFit:
    """The offset (beyond imu_minus_cam_s), rotation or mirror, and scale that make the gyro fit the images' rates best.

    First the offset by the magnitudes, which know no axes, then the axes by orthogonal Procrustes, then the offset by the vectors.
    """
    offsets_s = np.arange(-_SEARCH_S, _SEARCH_S + _STEP_S / 2, _STEP_S)
    seen = turns.rates_body_radps - turns.rates_body_radps.mean(axis=0)
    gyro = np.stack([_gyro_rates(turns, imu, imu_minus_cam_s + d) for d in offsets_s])
    speeds = np.linalg.norm(turns.rates_body_radps, axis=1)
    offset = int(np.argmax([_correlation(np.linalg.norm(rates, axis=1), speeds) for rates in gyro]))
    body_from_gyro = np.eye(3)
    for _ in range(3):
        body_from_gyro, _ = _axes(seen, gyro[offset])
        scores = np.array([_correlation((rates - rates.mean(0)) @ body_from_gyro.T, seen) for rates in gyro])
        offset = int(np.argmax(scores))
    body_from_gyro, axes_seen = _axes(seen, gyro[offset])
    turned = (gyro[offset] - gyro[offset].mean(axis=0)) @ body_from_gyro.T
    scale = float((turned * turned).sum() / max((turned * seen).sum(), 1e-12))
    signed = _signed_axes(seen, (gyro[offset] - gyro[offset].mean(axis=0)) / scale, turned / scale)
    return GyroFit(_peak(offsets_s, scores, offset), body_from_gyro, scale, float(scores[offset]), axes_seen, signed)


def _signed_axes(seen: Array, gyro: Array, best: Array) -> Array | None:
    least = float(((best - seen) ** 2).sum()) + _AS_WELL * float((seen**2).sum())
    good = [axes for axes in SIGNED_AXES if float(((gyro @ axes.T - seen) ** 2).sum()) <= 2.0 * least]
    return max(good, key=lambda axes: float(np.trace(axes)), default=None)


def _why_not(turns: CameraTurns, imu: ImuSamples, imu_minus_cam_s: float) -> tuple[str, str] | None:
    """Why the gyro cannot be judged and what recording could; None where it can."""
    if len(imu) < 10:
        return "there is no IMU", RECORD_IMU
    if len(turns.starts_ns) < _MIN_PAIRS:
        return (
            f"{len(turns.starts_ns)} pairs of consecutive frames could be compared, {_MIN_PAIRS} are needed",
            "record every frame",
        )
    rates = turns.rates_body_radps, _gyro_rates(turns, imu, imu_minus_cam_s)
    spreads = [float(np.sqrt(seen.var(axis=0).sum())) for seen in rates]  # an IMU that turns alone is another robot's
    if max(spreads) < _LEAST_RATE_RADPS:
        return (
            f"the camera hardly turns (rates vary by {spreads[0]:.3f} rad/s)",
            "drive curves, to the left and to the right",
        )
    return None


def _gyro_rates(turns: CameraTurns, imu: ImuSamples, shift_s: float) -> Array:
    """(K, 3) mean gyro rates over the intervals, moved by `shift_s` on the IMU's clock."""
    origin_ns = int(imu.stamps_ns[0])
    times_s = (imu.stamps_ns - origin_ns) * 1e-9
    steps = np.diff(times_s)[:, None] * 0.5 * (imu.gyro_radps[1:] + imu.gyro_radps[:-1])
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    start_s = (turns.starts_ns - origin_ns) * 1e-9 + shift_s
    end_s = (turns.ends_ns - origin_ns) * 1e-9 + shift_s
    angles = [np.interp(end_s, times_s, column) - np.interp(start_s, times_s, column) for column in turned.T]
    return np.stack(angles, axis=1) / (end_s - start_s)[:, None]


def _correlation(first: Array, second: Array) -> float:
    a, b = first - first.mean(axis=0), second - second.mean(axis=0)
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12))


def _axes(seen: Array, gyro: Array) -> tuple[Array, int]:
    """Orthogonal body_from_gyro (3, 3) and about how many axes both turn. Where one axis is not seen it completes a rotation."""
    u, singular, vt = np.linalg.svd(seen.T @ (gyro - gyro.mean(axis=0)))
    axes_seen = int((singular > 0.03 * singular[0]).sum())
    sign = 1.0 if axes_seen == 3 else float(np.sign(np.linalg.det(u @ vt)))
    full = u @ np.diag([1.0, 1.0, sign]) @ vt
    if axes_seen > 1:
        return full, axes_seen
    # About one axis only: the smallest rotation that brings the axes together, or its reverse
    return rotation_between_vectors(vt[0], u[:, 0]), axes_seen


def _peak(offsets_s: Array, scores: Array, index: int) -> float:
    if index in (0, len(scores) - 1):
        return float(offsets_s[index])
    before, here, after = scores[index - 1 : index + 2]
    bend = before - 2 * here + after
    return float(offsets_s[index] + (0.5 * (before - after) / bend * _STEP_S if bend < 0 else 0.0))


def _offset_finding(fit: GyroFit, imu_minus_cam_s: float) -> Finding:
    words = f"the IMU's stamps are {fit.offset_s * 1e3:+.1f} ms from what the calibration says"
    advice = f"set timeshift_cam_imu to {imu_minus_cam_s + fit.offset_s:+.4f} s, or stamp both by one clock"
    return judge(_NAMES[0], abs(fit.offset_s) * 1e3, Limits(6.0, 25.0, "ms"), words, f"{words}; {advice}")


def _scale_finding(fit: GyroFit) -> Finding:
    error = abs(fit.scale - 1)
    verdict = Verdict.OK if error < 0.1 else Verdict.WARN if error < 0.3 else Verdict.FAIL
    words = f"the gyro turns {fit.scale:.3f} times as fast as the images"
    if 40 < fit.scale < 80:
        words += "; it is in degrees per second, multiply it by pi/180"
    elif verdict is not Verdict.OK:
        words += "; check its unit, and the focal length in the calibration"
    return Finding(_NAMES[1], verdict, fit.scale, "warn 0.1, fail 0.3 from 1", words)


def _axes_finding(fit: GyroFit) -> Finding:
    limit = "warn above 4 degrees, fail above 15 degrees"
    about = f"judged about {fit.axes_seen} of 3 axes"
    if fit.signed is not None and np.trace(fit.signed) < 3.0:
        words = f"the gyro {axes_in_words(fit.signed)}: so the images turn, {about}"
        advice = "mend its driver's signs, or how the calibration mounts it (T_cam_imu)"
        return Finding(_NAMES[2], Verdict.FAIL, None, limit, f"{words}; {advice}")
    if np.linalg.det(fit.body_from_gyro) < 0:
        words = (
            f"the gyro's axes are mirrored ({in_axes(fit.body_from_gyro)}); one has the wrong sign or two are exchanged"
        )
        return Finding(_NAMES[2], Verdict.FAIL, None, limit, words)
    angle_deg = float(np.degrees(rotation_angle_rad(fit.body_from_gyro)))
    words = f"the gyro's axes are {angle_deg:.1f} degrees from the calibration, {about}"
    advice = "check body_from_cam (T_cam_imu) and how the IMU is mounted"
    bad = f"{words} ({in_axes(fit.body_from_gyro)}); {advice}"
    return judge(_NAMES[2], angle_deg, Limits(4.0, 15.0, "degrees"), words, bad)
