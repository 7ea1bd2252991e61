"""Assembly of the map from the adjusted state: descriptors, patches, uncertainties, trajectory."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.matching import packed
from fleetmap.features.patch_align import halvings
from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.finish.culling import Culled, cull
from mapserver.survey.finish.frame_adjustment import PlacedFrames
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Keyframe, Landmarks, OdometryPass, RigImages, SurveyState
from mapserver.survey.survey_map import SurveyMap

_PATCH_HALF_PX = 10  # margin so that a scaled or rotated 9 px window still fits
_CHUNK = 5000  # landmarks


def assemble(
    state: SurveyState, odometry: OdometryPass, placed: PlacedFrames, settings: SurveySettings
) -> tuple[SurveyMap, NDArray[np.int64], Culled]:
    """Return the SurveyMap of an adjusted survey, in the survey's own frame, its landmarks as rows of the state, and the removed ones."""
    images = RigImages.of(odometry.keyframes, state.map_from_body, state.rig).images
    state = state.by_image()
    every_sigma = point_sigmas_m(state)
    seen, kept, culled = cull(state, images, every_sigma, settings.cull)
    marks, rows = state.landmarks.keep_observations(seen, 1), np.unique(state.landmarks.obs_landmark[seen])
    keyframes = [k for k, keep in zip(images, kept, strict=True) if keep]
    marks = replace(marks, obs_keyframe=(np.cumsum(kept) - 1)[marks.obs_keyframe].astype(np.int32))
    octaves = marks.of_features([k.features.octaves for k in keyframes])
    frame_stamps = np.array([e.stamp_ns for e in odometry.estimates], np.int64)
    stamps_ns, map_from_kept = state.stamps_ns[kept], state.map_from_body[kept]
    handed_on = replace(state, stamps_ns=stamps_ns, map_from_body=map_from_kept, landmarks=marks)
    survey_map = SurveyMap(
        camera=state.rig.camera,
        body_from_cam=state.rig.body_from_cam[0],
        keyframe_stamps_ns=handed_on.stamps_ns,
        map_from_body=handed_on.map_from_body,
        landmark_ids=np.arange(len(marks.points_map), dtype=np.uint32),
        points_map=marks.points_map,
        descriptors=medoid_descriptors(marks, keyframes),
        point_sigma_m=point_sigmas_m(handed_on),
        obs_keyframe=marks.obs_keyframe,
        obs_landmark=marks.obs_landmark,
        obs_pixels=marks.obs_pixels,
        obs_octave=octaves,
        obs_sigma_px=marks.obs_sigma_px,
        trajectory=Trajectory(frame_stamps, placed.map_from_body),
        trajectory_estimated=_estimated(state, odometry, placed),
        patches=cut_patches(marks, keyframes),
        scale_known=odometry.scale_known,
    )
    return survey_map, rows.astype(np.int64), culled


def medoid_descriptors(marks: Landmarks, keyframes: list[Keyframe]) -> NDArray[np.uint8]:
    """Return (N, 32): of each landmark's descriptors the one nearest to all others (their medoid)."""
    rows = marks.of_features([k.features.descriptors for k in keyframes])
    starts = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map) + 1))
    return rows[core.medoids(packed(rows), starts)]


def point_sigmas_m(state: SurveyState) -> Array:
    """Return (N,) largest standard deviation of each landmark, for fixed keyframes of a single camera."""
    marks, map_from_cam = state.landmarks, state.map_from_cams[:, 0]
    weakest = np.empty(len(marks.points_map))
    for start in range(0, len(weakest), _CHUNK):  # working memory is 0.5 kB per observation
        some = slice(start, min(start + _CHUNK, len(weakest)))
        rows = slice(*np.searchsorted(marks.obs_landmark, [some.start, some.stop]))
        has_right, sigmas = np.isfinite(marks.obs_pixels[rows, 2]), marks.obs_sigma_px[rows]
        cameras, landmarks = map_from_cam[marks.obs_keyframe[rows]], marks.obs_landmark[rows] - start
        information = point_information(state.rig.camera, cameras, marks.points_map[some], landmarks, has_right, sigmas)
        weakest[some] = np.linalg.eigvalsh(information)[:, 0]
    return np.asarray(1.0 / np.sqrt(np.maximum(weakest, 1e-6)))


def point_information(
    camera: StereoCamera,
    map_from_cam: Array,
    points_map: Array,
    obs_landmark: NDArray[np.int32],
    has_right: NDArray[np.bool_],
    obs_sigma_px: Array,
) -> Array:
    """Return (N, 3, 3) information of M observations by known cameras map_from_cam (M, 4, 4) on N points, in map axes: sum of J^T J."""
    cam_from_map = se3_inverse(map_from_cam)
    rotations = cam_from_map[:, :3, :3]
    seen = np.einsum("mij,mj->mi", rotations, points_map[obs_landmark]) + cam_from_map[:, :3, 3]
    z = np.maximum(seen[:, 2], 0.05)
    f = camera.focal_px
    rows = np.zeros((len(z), 3, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = f / z
    rows[:, 0, 2], rows[:, 1, 2] = -f * seen[:, 0] / z**2, -f * seen[:, 1] / z**2
    rows[:, 2, 2] = np.where(has_right, -f * camera.baseline_m / z**2, 0.0)
    sigma = np.column_stack([obs_sigma_px[:, 0], obs_sigma_px[:, 0], obs_sigma_px[:, 1]])
    jacobian = (rows / sigma[:, :, None]) @ rotations
    information = np.zeros((len(points_map), 3, 3))
    np.add.at(information, obs_landmark, jacobian.transpose(0, 2, 1) @ jacobian)
    return information


def cut_patches(marks: Landmarks, keyframes: list[Keyframe]) -> NDArray[np.uint8]:
    """Return (N, 21, 21) windows around each landmark's first observation, at the halving nearest to its octave."""
    size = 2 * _PATCH_HALF_PX + 1
    out = np.zeros((len(marks.points_map), size, size), np.uint8)
    first = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map)))
    steps = np.arange(-_PATCH_HALF_PX, _PATCH_HALF_PX + 1)
    owners, features = marks.obs_keyframe[first], marks.obs_feature[first]
    for k in np.unique(owners).tolist():
        own = np.flatnonzero(owners == k)
        levels, pyramid = halvings(keyframes[k].features.octaves[features[own]]), keyframes[k].pyramid
        for level, image in enumerate(pyramid):
            index = own[levels == level]
            x, y = np.rint(marks.obs_pixels[first[index], :2] / 2.0**level).astype(int).T
            rows = np.clip(y[:, None] + steps, 0, image.shape[0] - 1)
            columns = np.clip(x[:, None] + steps, 0, image.shape[1] - 1)
            out[index] = image[rows[:, :, None], columns[:, None, :]]
    return out


def _estimated(state: SurveyState, odometry: OdometryPass, placed: PlacedFrames) -> NDArray[np.bool_]:
    """Return (F,) frames connected to the map by measurements: landmarks, unbroken odometry, or the IMU through a gap."""
    tied = odometry.tracked.astype(bool) | placed.seen
    if state.motion.inertial:
        tied[[k.frame_index for k in odometry.keyframes]] = True
    return tied
