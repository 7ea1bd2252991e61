"""Assembly of the map from the adjusted state: descriptors, patches, uncertainties, trajectory.

Left out are duplicate or inaccurate landmarks, and redundant keyframes.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.matching import packed
from fleetmap.features.patch_align import halvings
from fleetmap.geometry import Array, Indices, Mask
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.finish.frame_adjustment import PlacedFrames
from mapserver.survey.rig import Looks
from mapserver.survey.settings import CullSettings, SurveySettings
from mapserver.survey.state import Keyframe, Landmarks, OdometryPass, RigImages, SurveyState, of_features
from mapserver.survey.survey_map import SurveyMap

_PATCH_HALF_PX = 10  # margin so that a scaled or rotated 9 px window still fits
_CHUNK = 5000  # landmarks


@dataclass(frozen=True, slots=True)
class Culled:
    """Numbers of removed items: landmarks_merged into another, landmarks_weak, redundant keyframes."""

    landmarks_merged: int = 0
    landmarks_weak: int = 0
    keyframes_redundant: int = 0


def assemble(
    state: SurveyState, odometry: OdometryPass, placed: PlacedFrames, settings: SurveySettings
) -> tuple[SurveyMap, Indices, Culled]:
    """Return the SurveyMap of an adjusted survey, in the survey's own frame, its landmarks as rows of the state, and the removed ones."""
    images = RigImages.of(odometry.keyframes, state.map_from_body, state.rig).images
    state = state.by_image()
    camera, map_from_cam = state.rig.camera, state.map_from_cams[:, 0]
    seen, kept, culled = cull(state, images, point_sigmas_m(camera, map_from_cam, state.landmarks), settings.cull)
    marks, rows = state.landmarks.keep_observations(seen, 1), np.unique(state.landmarks.obs_landmark[seen])
    keyframes = [k for k, keep in zip(images, kept, strict=True) if keep]
    marks = replace(marks, obs_keyframe=(np.cumsum(kept) - 1)[marks.obs_keyframe].astype(np.int32))
    tied = odometry.tracked.astype(bool) | placed.seen  # frames connected to the map by landmarks or unbroken odometry
    if state.motion.inertial:  # or by the IMU through a gap
        tied[odometry.keyframe_frames] = True
    survey_map = SurveyMap(
        camera=camera,
        body_from_cam=state.rig.body_from_cam[0],
        keyframe_stamps_ns=state.stamps_ns[kept],
        map_from_body=state.map_from_body[kept],
        landmark_ids=np.arange(len(marks.points_map), dtype=np.uint32),
        points_map=marks.points_map,
        descriptors=medoid_descriptors(marks, keyframes),
        point_sigma_m=point_sigmas_m(camera, map_from_cam[kept], marks),
        obs_keyframe=marks.obs_keyframe,
        obs_landmark=marks.obs_landmark,
        obs_pixels=marks.obs_pixels,
        obs_octave=marks.of_features([k.features.octaves for k in keyframes]),
        obs_sigma_px=marks.obs_sigma_px,
        trajectory=Trajectory(odometry.stamps_ns, placed.map_from_body),
        trajectory_estimated=tied,
        patches=cut_patches(marks, keyframes),
        scale_known=odometry.scale_known,
    )
    return survey_map, rows.astype(np.int64), culled


def medoid_descriptors(marks: Landmarks, keyframes: list[Keyframe]) -> NDArray[np.uint8]:
    """Return (N, 32): of each landmark's descriptors the one nearest to all others (their medoid)."""
    rows = marks.of_features([k.features.descriptors for k in keyframes])
    return rows[core.medoids(packed(rows), marks.starts)]


def point_sigmas_m(camera: StereoCamera, map_from_cam: Array, marks: Landmarks) -> Array:
    """Return (N,) largest standard deviation of each landmark, for fixed keyframes of a single camera at map_from_cam (K, 4, 4)."""
    weakest = np.empty(len(marks.points_map))
    for start in range(0, len(weakest), _CHUNK):  # working memory is 0.5 kB per observation
        some = slice(start, min(start + _CHUNK, len(weakest)))
        rows = slice(*np.searchsorted(marks.obs_landmark, [some.start, some.stop]))
        cameras, landmarks = map_from_cam[marks.obs_keyframe[rows]], marks.obs_landmark[rows] - start
        looks = Looks(camera, cameras, landmarks, marks.obs_pixels[rows], marks.obs_sigma_px[rows])
        weakest[some] = np.linalg.eigvalsh(looks.information(marks.points_map[some]))[:, 0]
    return np.asarray(1.0 / np.sqrt(np.maximum(weakest, 1e-6)))


def cut_patches(marks: Landmarks, keyframes: list[Keyframe]) -> NDArray[np.uint8]:
    """Return (N, 21, 21) windows around each landmark's first observation, at the halving nearest to its octave."""
    size = 2 * _PATCH_HALF_PX + 1
    out = np.zeros((len(marks.points_map), size, size), np.uint8)
    first = marks.firsts
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


def cull(
    state: SurveyState, keyframes: list[Keyframe], sigmas_m: Array, settings: CullSettings
) -> tuple[Mask, Mask, Culled]:
    """Return the kept observations (M,) and keyframes (K,) of a single camera, and the removed ones; `state` is unchanged.

    sigmas_m (N,) of the landmarks.
    """
    marks = state.landmarks
    octaves = marks.of_features([k.features.octaves for k in keyframes])
    double = _duplicates(marks, keyframes, sigmas_m, settings)
    weak = ~double & (parallax_rad(state) < np.radians(settings.min_parallax_deg))
    lasting = ~(double | weak)
    superfluous = redundant(marks, octaves, lasting, len(keyframes), settings)
    keep = lasting[marks.obs_landmark] & ~superfluous[marks.obs_keyframe]
    return keep, ~superfluous, Culled(int(double.sum()), int(weak.sum()), int(superfluous.sum()))


def parallax_rad(state: SurveyState) -> Array:
    """Return (N,) the parallax angle of each landmark's observations: largest between any and the first, or across the baseline."""
    marks = state.landmarks
    centres = state.map_from_cams[marks.obs_keyframe, marks.obs_camera, :3, 3]
    rays = centres - marks.points_map[marks.obs_landmark]
    distances = np.maximum(np.linalg.norm(rays, axis=1), 1e-6)
    rays /= distances[:, None]
    cosines = np.einsum("ij,ij->i", rays, rays[marks.firsts][marks.obs_landmark])
    angles = np.zeros(len(marks.points_map))
    np.maximum.at(angles, marks.obs_landmark, np.arccos(np.clip(cosines, -1.0, 1.0)))
    across = np.where(np.isfinite(marks.obs_pixels[:, 2]), state.rig.camera.baseline_m / distances, 0.0)
    np.maximum.at(angles, marks.obs_landmark, across)
    return angles


def _duplicates(marks: Landmarks, keyframes: list[Keyframe], sigmas_m: Array, settings: CullSettings) -> Mask:
    """Return (N,) landmarks at the position of a better observed similar one, never seen beside it."""
    near = scipy.spatial.cKDTree(marks.points_map).query_pairs(settings.duplicate_m, output_type="ndarray")
    if not len(near):
        return np.zeros(len(marks.points_map), bool)
    near, first = near[np.lexsort((near[:, 1], near[:, 0]))].astype(np.int64), marks.firsts
    columns = [k.features.descriptors for k in keyframes]
    descriptors = packed(of_features(marks.obs_keyframe[first], marks.obs_feature[first], columns))
    landmarks = marks.points_map, sigmas_m, marks.starts, marks.obs_keyframe, descriptors
    return core.duplicate_landmarks(near, *landmarks, settings.duplicate_distance)


def redundant(marks: Landmarks, octaves: NDArray[np.int8], lasting: Mask, count: int, settings: CullSettings) -> Mask:
    """Return (count,) keyframes whose landmarks are to a `redundant_share` seen by three others at the same or a finer scale.

    Removed one by one, those with the fewest landmarks first, so that mutually redundant ones are not all removed.
    Source: Mur-Artal and Tardos 2015 (ORB-SLAM).
    """
    usable = np.flatnonzero(lasting[marks.obs_landmark])
    own = marks.obs_keyframe[usable]
    seen = np.bincount(own, minlength=count)
    order = np.array(sorted(range(1, count - 1), key=lambda k: (seen[k], k)), np.int64)
    rows, row_starts = usable[np.argsort(own, kind="stable")], np.concatenate([[0], np.cumsum(seen)])
    observed = marks.obs_landmark.astype(np.int64), marks.starts, marks.obs_keyframe.astype(np.int64), octaves
    limits = settings.redundant_observers, settings.redundant_share
    return core.redundant_keyframes(order, rows, row_starts, *observed, 0, *limits, 0)
