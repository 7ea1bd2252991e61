"""Checks of a rig with several views: each further pair as the first one, and the views against each other by the motion that each sees.

The body moves once, whichever camera measures it: if a view is mounted otherwise than the calibration says, its motions of the body are
those of the first view, conjugated by that error. Source: Tsai, Lenz 1989, A new technique for fully autonomous and efficient 3D robotics
hand/eye calibration.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, Mask, se3, se3_inverse, skew, so3_exp, so3_log, turned_cov
from fleetmap.recordings import Recording
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from mapserver.calibration import CalibrationParameter as P
from mapserver.doctor.calibration import SURE_SIGMAS
from mapserver.doctor.camera_motion import SceneError, body_motion, motion_between
from mapserver.doctor.findings import Finding, Verdict, not_judged
from mapserver.doctor.gyro_images import AXES, OFFSET
from mapserver.doctor.run_checks import frames_to_check, run_checks
from mapserver.doctor.stereo import SWAPPED

_INTERVALS, _APART_NS = 400, 200_000_000
_LEAST = 20
_PLACE_SIGMA_M, _SCALE_SIGMA = 0.1, 0.03  # of a mounting by hand, and of a baseline: unknown without turns
_EVERY, _HALF_VIEW_RAD = 10, 0.7  # intervals at which the scene is measured
_ROUNDS, _FAR_SIGMAS = 8, 3.5
_MAD_SIGMA = 1.4826  # standard deviation of a normal distribution by its median absolute deviation
_OF_CAMERAS = {p.value for p in P} - {P.WHEEL_SCALE.value, P.GYRO_NOISE.value, P.ACCEL_NOISE.value}
_OF_CAMERAS |= {SWAPPED, AXES, OFFSET, "epipolar error", "lens", "sharpness", "images", "camera rate", "camera gaps"}
_OF_CAMERAS.add("depth")
_DRIVE = "record a drive of a minute with turns, where every camera sees something near"


def frames_of_rig(recording: Recording) -> int:
    """Return the approximate number of `on_frame` calls by `check_rig`."""
    views = recording.calibration.views
    measuring = [recording.view(n) for n in range(len(views)) if n == 0 or _measures_depth(recording, n)]
    return sum(map(frames_to_check, measuring)) + (_INTERVALS if len(views) > 1 else 0)


def check_rig(recording: Recording, on_frame: Callable[[], None] = lambda: None) -> list[Finding]:
    """Return the findings of the first view; of each further pair and depth camera those about its cameras, with their names, and of each
    further view its mounting against the first one."""
    return run_checks(recording.view(0), on_frame).findings + further_findings(recording, on_frame)


def further_findings(recording: Recording, on_frame: Callable[[], None] = lambda: None) -> list[Finding]:
    """Return the findings of `check_rig` without those of the first view."""
    found, names = list[Finding](), _names(recording)
    for number in range(1, len(names)):
        if _measures_depth(recording, number) and len(recording.view(number)):
            beside = run_checks(recording.view(number), on_frame).findings
            found += [replace(f, name=f"{f.name} of {names[number]}") for f in beside if f.name in _OF_CAMERAS]
    return found + (_unlike_lenses(recording) + check_mountings(recording, on_frame) if len(names) > 1 else [])


def _unlike_lenses(recording: Recording) -> list[Finding]:
    """Return a warning for each view whose images are not rectified to the first one's pinhole."""
    first, *others = (mounted.camera for mounted in Rectifier(recording.calibration).mounted)
    words = "its focal length is more than 1.5 times from the first view's, so that a survey leaves its images out; use a lens alike"
    limit = f"the first view has {first.focal_px:.0f} px"
    return [
        Finding(f"field of view of {name}", Verdict.WARN, camera.focal_px, limit, words)
        for name, camera in zip(_names(recording)[1:], others, strict=True)
        if camera.focal_px != first.focal_px
    ]


def _measures_depth(recording: Recording, view: int) -> bool:
    numbers = recording.calibration.views[view]
    return len(numbers) == 2 or recording.calibration.cameras[numbers[0]].has_depth


def _names(recording: Recording) -> list[str]:
    return [" and ".join(f"cam{number}" for number in numbers) for numbers in recording.calibration.views]


@dataclass(frozen=True, slots=True)
class Mounting:
    """Error of a view's mounting against the first one, in body axes: rotation vector (3,), and its covariances (3, 3) by noise, and by
    errors that motions have in common."""

    turn_rad: Array
    cov: Array
    cov_repeated: Array


def check_mountings(recording: Recording, on_frame: Callable[[], None] = lambda: None) -> list[Finding]:
    """Return one finding for each view but the first."""
    names, rectifier = _names(recording), Rectifier(recording.calibration)
    motions: list[list[tuple[Array, Array]]] = [[] for _ in names]
    rigs = [(mounted.camera, mounted.body_from_cam) for mounted in rectifier.mounted]
    scenes: list[list[SceneError]] = [[] for _ in names]
    for count, (before, after) in enumerate(_intervals(recording, rectifier, on_frame)):
        first: Array | None = None
        for number, rig in enumerate(rigs):
            pair = (before.view(number), after.view(number)) if number else (before, after)
            if pair[0] is None or pair[1] is None:
                continue
            motion = body_motion(rig, (pair[0], pair[1]))[2]
            first = first if number else motion
            motions[number] += [] if motion is None or first is None else [(first, motion)]
            error = motion_between(pair[0], pair[1], rig[0])[1] if count % _EVERY == 0 else None
            scenes[number] += [] if error is None else [(turned_cov(error[0], rig[1][:3, :3]), error[1])]
    return [
        judge_mounting(
            f"{name} against {names[0]}", mounting_error(seen, _repeated(seen, [*scenes[0], *own], recording))
        )
        for name, seen, own in zip(names[1:], motions[1:], scenes[1:], strict=True)
    ]


def _repeated(motions: Sequence[tuple[Array, Array]], scenes: Sequence[SceneError], recording: Recording) -> Array:
    """Return the covariance (6, 6) of what scenes leave in the mean difference of two views' motions.

    A scene is new after a way as long as things are away, or a turn by half the view.
    """
    if not scenes or not motions:
        return np.zeros((6, 6))
    depth_m = float(np.median([depth_m for _, depth_m in scenes]))
    way = np.nanmean([0.0, *(np.linalg.norm(first[:3, 3]) for first, _ in motions)]) / depth_m
    turn = np.mean([np.linalg.norm(so3_log(first[:3, :3])) for first, _ in motions]) / _HALF_VIEW_RAD
    intervals = float(recording.frame_stamps_ns[-1] - recording.frame_stamps_ns[0]) / _APART_NS
    return np.asarray(2.0 * np.mean([cov for cov, _ in scenes], axis=0) / (1.0 + (way + turn) * intervals))


def judge_mounting(name: str, found: Mounting | None) -> Finding:
    """Judge an error of a mounting; to its own sigma are added what lenses leave in the motion of either view."""
    tolerance = P.CAMERA_IMU_X
    if found is None:
        return not_judged(name, "too few frames of both could be followed", _DRIVE)
    variances, axes = np.linalg.eigh(found.cov)
    variances += np.diag(axes.T @ found.cov_repeated @ axes) + 2 * tolerance.least_sigma**2
    sigmas, along = np.sqrt(variances), axes.T @ found.turn_rad
    is_known = (sigmas <= tolerance.warn_above) | (np.abs(along) > SURE_SIGMAS * sigmas)
    turn_rad = axes @ np.where(is_known, along, 0.0)
    worst = int(np.argmax(np.where(is_known, np.abs(along) / sigmas, -1.0)))
    excess_rad, size_deg = abs(along[worst]) - SURE_SIGMAS * sigmas[worst], float(np.degrees(np.linalg.norm(turn_rad)))
    angles = ", ".join(f"{degrees:+.2f}" for degrees in np.degrees(turn_rad))
    words = f"turned by {angles} degrees about the body's axes, by the motion that both see"
    limit = f"warn above {SURE_SIGMAS:g} sigma, {np.degrees(SURE_SIGMAS * sigmas[worst]):.2f} degrees"
    if is_known[worst] and excess_rad > 0:
        verdict = Verdict.FAIL if excess_rad > tolerance.fail_above else Verdict.WARN
        words += "; calibrate all cameras again, or name the matching file with --calibration"
        return Finding(name, verdict, size_deg, limit, words)
    if not is_known.all():
        return not_judged(name, f"known to {np.degrees(sigmas.max()):.2f} degrees only", _DRIVE)
    return Finding(name, Verdict.OK, size_deg, limit, words)


def mounting_error(motions: Sequence[tuple[Array, Array]], repeated: Array | None = None) -> Mounting | None:
    """Return the error of a view's mounting by motions (4, 4) of the body, earlier_from_later, by the first view and by that one.

    Gauss-Newton for rotation, position and scale of the other view, by residuals weighted by their own spread; a translation of NaN does
    not count. None with too few motions. repeated: covariance (6, 6) of an error that all differences of the two motions have in common.
    """
    if len(motions) < _LEAST:
        return None
    first, other = (np.array(each) for each in zip(*motions, strict=True))
    has_way = np.isfinite(first[:, :3, 3] + other[:, :3, 3]).all(axis=1)
    is_known = np.column_stack([np.ones((len(first), 3), bool), np.tile(has_way[:, None], 3)])
    first, other = np.nan_to_num(first), np.nan_to_num(other)
    error, scale = se3(_aligned(first, other, has_way), np.zeros(3)), 0.0
    prior = np.diag([0.0] * 3 + [_PLACE_SIGMA_M**-2] * 3 + [_SCALE_SIGMA**-2])
    cov = np.eye(7)
    for _ in range(_ROUNDS):
        # Motions of the body that a view with this error of its mounting has seen.
        scaled = [se3(each[:3, :3], each[:3, 3] * (1.0 + scale)) for each in other]
        moved = np.array([error @ each @ se3_inverse(error) for each in scaled])
        rows, residuals = _linearized(first, moved)
        spread = np.where(is_known, np.abs(residuals), 0.0)
        sigmas = np.maximum(_MAD_SIGMA * np.median(spread[has_way | ~has_way.any()], axis=0), 1e-9)
        is_far = (spread > _FAR_SIGMAS * sigmas).any(axis=1, keepdims=True)  # one of its motions is wrong
        weights = np.where(is_far | ~is_known, 0.0, sigmas**-2.0)
        information = np.einsum("kri,kr,krj->ij", rows, weights, rows) + prior
        cov = np.linalg.inv(information + 1e-9 * np.eye(7))
        at = np.concatenate([np.zeros(3), error[:3, 3], [scale]])
        step = cov @ (np.einsum("kri,kr,kr->i", rows, weights, residuals) - prior @ at)
        error = se3(so3_exp(step[:3]) @ error[:3, :3], error[:3, 3] + step[3:6])
        scale += float(step[6])
    lever = (cov @ np.einsum("kri,kr->ir", rows, weights))[:3]
    by_noise = 2.0 * float((weights > 0).any(axis=1).sum())  # which turns and ways of noise alone would seem to give
    known, axes = np.linalg.eigh(np.linalg.inv(cov[:3, :3]))
    cov = axes @ np.diag(1.0 / np.maximum(known - by_noise, 1.0)) @ axes.T
    return Mounting(so3_log(error[:3, :3]), cov, lever @ (np.zeros((6, 6)) if repeated is None else repeated) @ lever.T)


def _linearized(first: Array, other: Array) -> tuple[Array, Array]:
    """Rows (K, 6, 7) by rotation, position and scale, and residuals (K, 6): rotation vectors and translations, first minus other."""
    rows, residuals = np.zeros((len(first), 6, 7)), np.zeros((len(first), 6))
    for k, (one, two) in enumerate(zip(first, other, strict=True)):
        turn, way = so3_log(two[:3, :3]), two[:3, 3]
        residuals[k] = np.concatenate([so3_log(one[:3, :3]) - turn, one[:3, 3] - two[:3, 3]])
        rows[k, :3, :3], rows[k, 3:, :3] = -skew(turn), -skew(way)
        rows[k, 3:, 3:6], rows[k, 3:, 6] = np.eye(3) - two[:3, :3], way
    return rows, residuals


def _aligned(first: Array, other: Array, has_way: Mask) -> Array:
    """Rotation (3, 3) that turns the other view's rotations and translations nearest to the first one's, by none where they do not show.
    Source: Kabsch 1976."""
    turns = [np.array([so3_log(motion[:3, :3]) for motion in each]) for each in (first, other)]
    ways = [each[has_way, :3, 3] for each in (first, other)]
    cross = 0.2 * np.eye(3) + sum(
        one.T @ two / max(float(np.linalg.norm(one) * np.linalg.norm(two)), 1e-12) for one, two in (turns, ways)
    )
    left, _, right = np.linalg.svd(cross)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def _intervals(
    recording: Recording, rectifier: Rectifier, on_frame: Callable[[], None]
) -> Iterator[tuple[RectifiedFrame, RectifiedFrame]]:
    """Yield pairs of frames so far apart that a robot moves and most points stay in the picture, spread over the recording."""
    stamps_ns = recording.frame_stamps_ns
    later = np.searchsorted(stamps_ns, stamps_ns + _APART_NS)
    begins = np.flatnonzero(later < len(stamps_ns))
    begins = begins[stamps_ns[later[begins]] - stamps_ns[begins] < 2 * _APART_NS]
    for row in np.unique(np.linspace(0, len(begins) - 1, min(_INTERVALS, len(begins))).round().astype(int)):
        on_frame()
        begin = int(begins[row])
        try:
            before, after = (rectifier.rectify(recording.read_frame(each)) for each in (begin, int(later[begin])))
        except RecordingError:  # said by the check of the first view
            continue
        yield before, after
