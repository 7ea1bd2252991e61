"""Check of the extrinsic yaw between the cameras of a pair, from survey data.

A small rotation of the right camera about its vertical axis shifts all disparities by nearly the same amount, which
bends depth and so changes the scale of the map. Motion reveals it: only with the true shift do the points triangulated by the pair
agree with those from several keyframes. The estimated shift minimises the adjusted cost; the cost's slope needs no derivative of
the adjustment, because all other derivatives vanish at its optimum.
"""

from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import bundle_problem
from mapserver.survey.bundle.problem import BundleProblem, measured_sigmas
from mapserver.survey.rig import CameraKind
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Landmarks, SurveyState

_FIRST_TRY_PX = 0.05
_MAX_STEPS = 4
_MIN_DISPARITIES = 200


@dataclass(frozen=True, slots=True)
class StereoYaw:
    """Excess of disparities in the middle of the picture, its sigma, and whether the survey corrects it.

    is_earlier: taken from an earlier survey of the rig.
    """

    shift_px: float
    sigma_px: float
    corrected: bool
    is_earlier: bool = False

    @property
    def correction_px(self) -> float:
        """Correction that the survey subtracts."""
        return self.shift_px if self.corrected else 0.0


NO_YAW = StereoYaw(0.0, float("inf"), corrected=False)


def disparity_shift(camera: StereoCamera, pixels: Array) -> Array:
    """Return (M,) derivative of the disparity at left pixels (M, >= 2) by the shift in the middle of the picture."""
    return np.asarray(1.0 + ((pixels[:, 0] - camera.cx_px) / camera.focal_px) ** 2)


def without_stereo_yaw(landmarks: Landmarks, camera: StereoCamera, *corrections_px: float) -> Landmarks:
    """Return the landmarks with all observed disparities reduced by the shift, one for each camera of a rig."""
    if not any(corrections_px):
        return landmarks
    pixels = landmarks.obs_pixels.copy()
    pixels[:, 2] += np.array(corrections_px)[landmarks.obs_camera] * disparity_shift(camera, pixels)
    return replace(landmarks, obs_pixels=pixels)


def estimate_stereo_yaw(state: SurveyState, settings: SurveySettings, camera: int = 0) -> StereoYaw:
    """Return the yaw error of a camera's pair with the best fit to the adjusted survey; corrected if significantly different from zero.

    sigma_px combines the adjustment's own with `noise.turn_floor_px`, since matching alone is overconfident. NO_YAW if too few
    disparities are known or if the cost has no minimum nearby.
    """
    measured = np.isfinite(state.landmarks.obs_pixels[:, 2]) & (state.landmarks.obs_camera == camera)
    if measured.sum() < _MIN_DISPARITIES or state.rig.kinds[camera] is CameraKind.DEPTH:
        return NO_YAW
    problem = bundle_problem(state, settings, None)
    problem = replace(problem, obs_sigma_px=measured_sigmas(problem, settings.final_bundle.huber_sigmas))
    slope = _slope(problem, state.landmarks, 0.0, settings, camera)
    shift, curvature = 0.0, 0.0
    step = _FIRST_TRY_PX if slope < 0 else -_FIRST_TRY_PX
    for _ in range(_MAX_STEPS):
        moved = _slope(problem, state.landmarks, shift + step, settings, camera)
        curvature = (moved - slope) / step
        if not curvature > 0.0:
            return NO_YAW
        shift, slope = shift + step, moved
        step = -slope / curvature
        if abs(step) < 0.2 / np.sqrt(curvature):
            break
    shift += step
    sigma = float(np.hypot(1.0 / np.sqrt(curvature), settings.noise.turn_floor_px))
    return StereoYaw(float(shift), sigma, corrected=abs(shift) > settings.noise.turn_sigmas * sigma)


def _slope(problem: BundleProblem, marks: Landmarks, shift_px: float, settings: SurveySettings, number: int) -> float:
    """Return the derivative of the adjusted cost by a camera's shift, everything else at its optimum for this shift."""
    camera, shifts_px = problem.rig.camera, np.zeros(len(problem.rig))
    shifts_px[number] = shift_px
    marks = without_stereo_yaw(marks, camera, *shifts_px)
    result = optimize(replace(problem, obs_pixels=marks.obs_pixels), settings.final_bundle)
    ahead = se3_inverse(problem.rig.map_from_cams(result.map_from_body))[marks.obs_keyframe, marks.obs_camera, 2]
    points = result.points_map[marks.obs_landmark]
    depth = np.einsum("mj,mj->m", ahead[:, :3], points) + ahead[:, 3]
    off = marks.obs_pixels[:, 0] - marks.obs_pixels[:, 2] - camera.focal_px * camera.baseline_m / depth
    # weight of each observation under the robust cost
    norm, robust = np.sqrt(result.squared_sigmas), settings.final_bundle
    weights = np.minimum(1.0, robust.huber_sigmas / np.maximum(norm, 1e-9))
    weights[norm > robust.cutoff_sigmas] = 0.0
    pull = weights * off / problem.obs_sigma_px[:, 1] ** 2
    own = marks.obs_camera == number
    return -float(np.nansum((pull * disparity_shift(camera, marks.obs_pixels))[own]))
