"""Calibration of a camera pair from the image size and the baseline only: initial focal length = image width, no distortion.

First epipolar geometry: matches of the pair and of the left camera in time, in raw pixels. It assumes two lenses of one type with
square pixels and nearly parallel axes. Every focal length of a wide range is tried; the best fit is within some per cent.
Then passes of the self-calibrating adjustment with wide priors, by images alone; after each the images are rectified and
tracked again. It ends when the focal length has converged, and fails with an error if it does not.
Sources: Hartley and Zisserman 2004, section 11.4 (Sampson distance); Brown 1966 (distortion).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from msgspec import structs
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from fleetmap.errors import RecordingError
from fleetmap.features.extraction import extract
from fleetmap.features.matching import match_mutual
from fleetmap.features.orb import Features
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, se3, se3_inverse, skew, so3_exp, so3_log
from fleetmap.recordings.calibration_files import format_calibration
from fleetmap.recordings.recording import Recording
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import Rectifier
from mapserver.calibration.estimate import MIN_KEYFRAMES
from mapserver.calibration.estimator import Adjusted, adjust
from mapserver.calibration.parameters import INDEX, CalibrationParameter, RigAxes, corrected_rig
from mapserver.calibration.recordings import busiest_frames, followed
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyTools

P = CalibrationParameter
# Radial and tangential terms of any pinhole lens, their difference between two of one make, the right principal point in pixels
_WIDE_SIGMAS = np.array([0.3, 0.3, 1e-3, 1e-3] + [1e-2, 1e-2, 1e-3, 1e-3] + [15.0] * 2)
_MOST_PASSES, _SETTLED = 7, 0.003  # of the focal length, as a share
_LARGEST_PIXEL_SCALE = 3.0  # of the pixels' noise: above, no pinhole lens fits the images
# Error of images alone, in addition to their own sigma: the recordings of the development were off by 0.8 to 1.1 %
FOCAL_FLOOR = 0.01
_MOMENTS, _STEPS, _MATCHES = 20, (4, 10), 120
_LEAST_FLOW_PX = 8.0  # of a motion, in the median


@dataclass(frozen=True)
class RawMatches:
    """Matched raw pixels (N, 4), u v of each view: of the pair, and for each motion of the left camera."""

    pair: Array
    motions: Sequence[Array]


@dataclass(frozen=True, slots=True)
class GuessedCalibration:
    """rig: estimated by images alone, with the given baseline. focal_sigma: relative. passes: number of times the images were tracked."""

    rig: RigCalibration
    focal_sigma: float
    keyframes: int
    passes: int


def first_rig(width_px: int, height_px: int, baseline_m: float) -> RigCalibration:
    """Return two parallel pinholes at this baseline, with a focal length of the image's width, and no IMU."""
    lens = np.array([width_px, width_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1)], np.float64)
    left = CameraCalibration("radial-tangential", width_px, height_px, lens, np.zeros(4), np.eye(4))
    return RigCalibration((left, replace(left, body_from_cam=se3(np.eye(3), np.array([baseline_m, 0.0, 0.0])))))


def calibration_from_guess(
    recording: Recording, settings: SurveySettings, tools: SurveyTools | None = None
) -> GuessedCalibration:
    """Estimate the lenses and relative pose of the pair from a recording opened with `first_rig`.

    RecordingError if they are unobservable: too little motion, passes without convergence, images that no pinhole lens fits.
    """
    if len(recording.calibration.cameras) < 2:
        raise RecordingError(f"{recording.path} has one camera: only the lenses of a pair can be guessed")
    tools = tools or SurveyTools()
    settings = structs.replace(settings, orb=structs.replace(settings.orb, count=700))
    sound, _ = recording.readable(busiest_frames(recording.frame_stamps_ns, recording.imu))
    alone = replace(sound, wheel=())
    rig = guessed_rig(recording.calibration, raw_matches(alone, tools.progress))
    for number in range(_MOST_PASSES):
        data = replace(followed(alone, rig, settings, tools), lens_sigmas=_WIDE_SIGMAS)
        found = adjust(data)
        theta = found.theta.copy()
        theta[[INDEX[P.BASELINE], INDEX[P.WHEEL_SCALE]]] = 0.0  # images alone have no scale
        rig = corrected_rig(rig, RigAxes.of(rig, Rectifier(rig)), np.concatenate([theta, found.lens]))
        if number > 0 and abs(theta[INDEX[P.FOCAL]]) < _SETTLED:
            return _judged(rig, found, len(data.stamps_ns), number + 1)
    raise RecordingError(
        f"{recording.path}: after {_MOST_PASSES} passes the focal length still moves by {100 * abs(theta[INDEX[P.FOCAL]]):.1f} % a "
        "pass, so nothing is written; record turns to both sides near to things, or calibrate with a board"
    )


def _judged(rig: RigCalibration, found: Adjusted, keyframes: int, passes: int) -> GuessedCalibration:
    own = float(np.sqrt(np.linalg.inv(found.information)[INDEX[P.FOCAL], INDEX[P.FOCAL]]))
    scale = float(found.scales.images[0])
    if keyframes < MIN_KEYFRAMES or own > FOCAL_FLOOR or scale > _LARGEST_PIXEL_SCALE:
        raise RecordingError(
            f"{keyframes} keyframes show the focal length to {100 * own:.1f} %, with errors of {scale:.1f} times what corners have: "
            f"not enough to tell the lenses; {MIN_KEYFRAMES} keyframes with turns and pinhole lenses are needed"
        )
    return GuessedCalibration(rig, float(np.hypot(own, FOCAL_FLOOR)), keyframes, passes)


def raw_matches(recording: Recording, on_progress: Callable[[str, int, int], None]) -> RawMatches:
    """Return matches of unrectified images at times spread over the stretch with the most motion."""
    frames = busiest_frames(recording.frame_stamps_ns, recording.imu)
    settings, rng = OrbSettings(count=1500), np.random.default_rng(0)
    pairs, motions = [], []
    for n, at in enumerate(np.linspace(0, len(frames) - 1 - max(_STEPS), _MOMENTS).astype(int).tolist()):
        on_progress("matching", n, _MOMENTS)
        frame = recording.read_frame(int(frames[max(at, 0)]))
        left = extract(frame.left, settings)
        if frame.right is not None:
            pairs.append(_chosen(_matched(left, extract(frame.right, settings)), rng))
        for step in _STEPS:
            later = recording.read_frame(int(frames[min(max(at, 0) + step, len(frames) - 1)]))
            match = _matched(left, extract(later.left, settings))
            if len(match) > 60 and np.median(np.linalg.norm(match[:, :2] - match[:, 2:], axis=1)) > _LEAST_FLOW_PX:
                motions.append(_chosen(match, rng))
    return RawMatches(np.concatenate(pairs) if pairs else np.zeros((0, 4)), motions)


def _chosen(matches: Array, rng: np.random.Generator) -> Array:
    return matches[rng.permutation(len(matches))[:_MATCHES]]


def _matched(first: Features, second: Features) -> Array:
    """(N, 4) raw pixels of mutual nearest descriptors that one epipolar geometry explains to 3 px."""
    if min(len(first.pixels), len(second.pixels)) < 30:
        return np.zeros((0, 4))
    a, b = match_mutual(first.descriptors, second.descriptors, 44, np.inf).T
    if len(a) < 30:
        return np.zeros((0, 4))
    matches = np.column_stack([first.pixels[a], second.pixels[b]]).astype(np.float64)
    cv2.setRNGSeed(0)
    _, fits = cv2.findFundamentalMat(matches[:, :2], matches[:, 2:], cv2.FM_RANSAC, 3.0, 0.99)
    return matches[fits.ravel() > 0] if fits is not None else np.zeros((0, 4))


_START_SHARES = (0.6, 1.0, 1.4)  # focal lengths in image widths: from 80 to 40 degrees across
_ROBUST_PX = 0.5
_MOST_EVALUATIONS = 60
# Sigmas of lenses and mounts a priori: right centre in widths, distortion in widths, angles, direction.
_CENTRE_SIGMA, _DISTORTION_SIGMA, _TURN_SIGMA, _DIRECTION_SIGMA = 0.02, 1.0, 0.05, 0.03
_GRID = (30, 24)  # pixels at which a lens is compared with another
_LENS, _MOTION = 10, 6  # unknowns: of the rig, of each motion
_LARGEST_SIGMA = 0.25  # of the focal length: the adjustment converges from within it; beyond is untested


class _Unknowns(NamedTuple):
    """Rig: log of the focal length in widths, k1 k2 in widths, rotation and direction y z of the right camera, its centre in widths."""

    focal: float
    distortion: Array
    turn: Array
    direction: Array
    centre: Array

    @classmethod
    def of(cls, values: Array) -> "_Unknowns":
        return cls(float(np.exp(values[0])), values[1:3], values[3:6], values[6:8], values[8:10])


def guessed_rig(given: RigCalibration, matches: RawMatches) -> RigCalibration:
    """Return `given` with lenses and the pair's rotation estimated from the matches; the length of the baseline is unchanged.

    RecordingError if the focal length is unobservable.
    """
    width = given.cameras[0].width_px
    left_m, right_m = (camera.body_from_cam[:3, 3] for camera in given.cameras)
    if len(matches.pair) < 100 or not matches.motions:
        raise RecordingError(
            f"{len(matches.pair)} matches between the cameras and {len(matches.motions)} motions of the left one: too few to "
            "guess lenses from; record a drive with turns in the light"
        )
    problem = _EpipolarProblem(given.cameras[0], matches)
    fits = [problem.fit(share) for share in _START_SHARES]
    _, sigma, best = min(fits, key=lambda fit: fit[0])
    found = _Unknowns.of(best)
    if not sigma <= _LARGEST_SIGMA or not 0.3 <= found.focal <= 3.0:
        raise RecordingError(
            f"the focal length is known to {100 * sigma:.0f} % only: the lenses cannot be guessed from this drive; record turns "
            "to both sides, or give a calibration file"
        )
    focal_px = found.focal * width
    left = _distorted(given.cameras[0], focal_px, found.distortion)
    right = replace(left, intrinsics_px=left.intrinsics_px + np.concatenate([np.zeros(2), found.centre * width]))
    apart = np.array([1.0, *found.direction])
    body_from_right = left.body_from_cam @ se3(
        so3_exp(found.turn), apart * (np.linalg.norm(right_m - left_m) / np.linalg.norm(apart))
    )
    return replace(given, cameras=(left, replace(right, body_from_cam=body_from_right)))


class _EpipolarProblem:
    """Sampson distances of all matches, in pixels, as a function of the rig and of each motion."""

    def __init__(self, camera: CameraCalibration, matches: RawMatches) -> None:
        self.width, self.middle, self.matches = camera.width_px, _middle(camera), matches

    def fit(self, share: float) -> tuple[float, float, Array]:
        """Return the cost of the best fit near a focal length in widths, relative sigma of the focal length, the unknowns."""
        start = np.zeros(_LENS + _MOTION * len(self.matches.motions))
        start[0] = np.log(share)
        for n, match in enumerate(self.matches.motions):
            start[_LENS + _MOTION * n :][:_MOTION] = self._motion(match, share * self.width)
        fit = least_squares(
            self.residuals,
            start,
            loss="soft_l1",
            f_scale=_ROBUST_PX,
            jac_sparsity=self._pattern(),
            max_nfev=_MOST_EVALUATIONS,
            x_scale="jac",
        )
        jacobian = np.asarray(fit.jac.todense())  # type: ignore[union-attr]
        information = jacobian.T @ jacobian + 1e-9 * np.eye(len(start))
        return float(fit.cost), float(np.sqrt(np.linalg.inv(information)[0, 0])), np.asarray(fit.x)

    def residuals(self, values: Array) -> Array:
        """Return distances of the pair's matches, of each motion's, then deviations of the unknowns from their priors, in sigmas."""
        rig = _Unknowns.of(values)
        pair, focal_px = self.matches.pair, rig.focal * self.width
        left, right = self._rays(pair[:, :2], rig, 0), self._rays(pair[:, 2:], rig, 1)
        apart = np.array([1.0, *rig.direction])
        rows = [focal_px * _sampson(left, right, so3_exp(rig.turn), apart / np.linalg.norm(apart))]
        usual = [rig.distortion / _DISTORTION_SIGMA, rig.turn / _TURN_SIGMA]
        usual += [rig.direction / _DIRECTION_SIGMA, rig.centre / _CENTRE_SIGMA]
        for match, motion in zip(self.matches.motions, values[_LENS:].reshape(-1, _MOTION), strict=True):
            before, after = self._rays(match[:, :2], rig, 0), self._rays(match[:, 2:], rig, 0)
            length = float(np.linalg.norm(motion[3:]))
            rows.append(focal_px * _sampson(before, after, so3_exp(motion[:3]), motion[3:] / length))
            usual.append(np.array([length - 1.0]))
        return np.concatenate([*rows, *usual])

    def _rays(self, pixels: Array, rig: _Unknowns, number: int) -> Array:
        """Return (N, 3) rays with z = 1; radial terms use the distorted position, so no inversion is needed."""
        places = (pixels - self.middle) / self.width - number * rig.centre
        return np.column_stack([_straight(places, rig.distortion) / rig.focal, np.ones(len(pixels))])

    def _motion(self, match: Array, focal_px: float) -> Array:
        """(6,) rotation vector and direction of a motion, under a focal length."""
        matrix = np.diag([focal_px, focal_px, 1.0])
        matrix[:2, 2] = self.middle
        essential, _ = cv2.findEssentialMat(match[:, 2:], match[:, :2], matrix, cv2.RANSAC, 0.99, 1.5)
        if essential is None or essential.shape != (3, 3):
            return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        _, turn, way, _ = cv2.recoverPose(essential, match[:, 2:], match[:, :2], matrix)
        return np.concatenate([so3_log(np.asarray(turn, np.float64)), way.ravel()])

    def _pattern(self) -> csr_matrix:
        """Return the sparsity: which residual depends on which unknown."""
        counts = [len(match) for match in self.matches.motions]
        rows, numbers = [len(self.matches.pair), sum(counts), _LENS - 1, len(counts)], np.arange(len(counts))
        of_rig = np.repeat([_LENS, 3, _LENS, 0], rows)[:, None]  # a motion of the left camera shows its lens alone
        motion = np.r_[np.full(rows[0], -1), np.repeat(numbers, counts), np.full(rows[2], -1), numbers][:, None]
        columns = np.arange(_LENS + _MOTION * len(counts))
        return csr_matrix((columns < of_rig) | ((columns >= _LENS) & ((columns - _LENS) // _MOTION == motion)))


def _sampson(first: Array, second: Array, rotation: Array, direction: Array) -> Array:
    """(N,) distances of rays (N, 3), z = 1, from the epipolar lines of a motion: first = rotation second + direction."""
    essential = skew(direction) @ rotation
    line, other = second @ essential.T, first @ essential
    scale = np.sqrt((line[:, :2] ** 2).sum(axis=1) + (other[:, :2] ** 2).sum(axis=1))
    return np.asarray((first * line).sum(axis=1) / np.maximum(scale, 1e-12))


def _middle(camera: CameraCalibration) -> Array:
    return np.array([0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1)])


def _straight(places: Array, terms: Array) -> Array:
    """Return (N, 2) positions without distortion, by two radial terms of the distorted ones (N, 2), both in widths."""
    squared = (places**2).sum(axis=1)
    return np.asarray(places * (1.0 + terms[0] * squared + terms[1] * squared**2)[:, None])


def _distorted(camera: CameraCalibration, focal_px: float, terms: Array) -> CameraCalibration:
    """Return the radial-tangential lens with the rays of the guess, by least squares over the image."""
    sides_px, middle = (camera.width_px - 1, camera.height_px - 1), _middle(camera)
    grid = np.meshgrid(*(np.linspace(0, side_px, count) for side_px, count in zip(sides_px, _GRID, strict=True)))
    pixels = np.stack(grid, axis=-1).reshape(-1, 2)
    straight = _straight((pixels - middle) / camera.width_px, terms) * (camera.width_px / focal_px)
    around = (straight**2).sum(axis=1)[:, None]
    design = np.column_stack([(straight * around).ravel(), (straight * around**2).ravel()])
    found = np.linalg.lstsq(design, ((pixels - middle) / focal_px - straight).ravel(), rcond=None)[0]
    intrinsics = np.array([focal_px, focal_px, *middle])
    return replace(camera, intrinsics_px=intrinsics, distortion=np.array([*found, 0.0, 0.0]))


def guessed_in_words(found: GuessedCalibration) -> list[str]:
    """Return text on the results from images alone, and the parameters that they cannot show."""
    left, right = found.rig.cameras
    turn = np.degrees(so3_log((se3_inverse(left.body_from_cam) @ right.body_from_cam)[:3, :3]))
    lenses = [
        f"cam{n}: focal length {c.intrinsics_px[0]:.1f} px, sigma {found.focal_sigma * c.intrinsics_px[0]:.1f}; centre "
        f"{c.intrinsics_px[2]:.1f} {c.intrinsics_px[3]:.1f}; distortion {' '.join(f'{k:+.4f}' for k in c.distortion)}"
        for n, c in enumerate((left, right))
    ]
    angles = f"cam1 is turned against cam0 by {turn[0]:+.2f} {turn[1]:+.2f} {turn[2]:+.2f} degrees"
    lacking = "not judged: the baseline's length, which is as given, and how IMU and wheels are mounted"
    return [*lenses, angles, lacking, f"{found.keyframes} keyframes, {found.passes} passes, images alone"]


def guessed_file(found: GuessedCalibration, name: str) -> str:
    """Return the text of a camchain of the result."""
    first = f"Found by `mapserver calibrate` from {name}, beginning with focal length = image width."
    return "".join(f"# {line}\n" for line in (first, *guessed_in_words(found))) + format_calibration(found.rig)
