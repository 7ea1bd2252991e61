"""Depths of a single camera's features, triangulated from neighbouring keyframes in place of a second camera."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap.features.matching import match_mutual
from fleetmap.geometry import Array, Indices, se3_inverse, transform_points
from fleetmap.odometry.mono.two_view import triangulate_pair
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.rig import CameraKind, Rig
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Keyframe, OdometryPass


class MonoDepths:
    """Triangulates features of single-camera keyframes with neighbours in time; matches are searched once."""

    def __init__(self, keyframes: Sequence[Keyframe], camera: StereoCamera, settings: SurveySettings) -> None:
        self._camera, self._settings = camera, settings
        self._keyframes: list[Keyframe] = []
        self._matches: dict[tuple[int, int], Indices] = {}
        self.grow(keyframes)

    def grow(self, keyframes: Sequence[Keyframe]) -> None:
        """Extend the chain; known keyframes come first."""
        known, pairs = len(self._keyframes), self._settings.pairs
        self._keyframes += keyframes[known:]
        for j in range(known, len(self._keyframes)):
            for i in range(max(0, j - self._settings.monocular.depth_views), j):
                a, b = (self._keyframes[k].features.descriptors for k in (i, j))
                self._matches[i, j] = match_mutual(a, b, pairs.max_distance, pairs.ratio)

    def release(self, k: int) -> None:
        """Release a keyframe's pictures."""
        self._keyframes[k] = self._keyframes[k].without_pictures()

    def keyframes_at(self, map_from_cam: Array, first: int = 0) -> list[Keyframe]:
        """Return the keyframes from `first` on with disparities and points of features on which several agree, the others without.

        map_from_cam (K, 4, 4).
        """
        found: list[list[Array]] = [[] for _ in self._keyframes]  # rows of feature, inverse depth, its sigma
        for j in range(first, len(self._keyframes)):
            for i in range(max(first, j - self._settings.monocular.depth_views), j):
                j_from_i = se3_inverse(map_from_cam[j]) @ map_from_cam[i]
                rows_i, rows_j = self._measure(i, j, self._matches[i, j], j_from_i)
                found[i].append(rows_i)
                found[j].append(rows_j)
        return [
            self._with_depths(k, np.concatenate(found[k]) if found[k] else np.zeros((0, 3)))
            for k in range(first, len(self._keyframes))
        ]

    def _measure(self, i: int, j: int, match: Indices, j_from_i: Array) -> tuple[Array, Array]:
        """Return for both keyframes rows (P, 3) of feature, inverse depth and its sigma."""
        a, b, s = self._keyframes[i].features, self._keyframes[j].features, self._settings.monocular
        pixels_a, pixels_b = a.pixels[match[:, 0]], b.pixels[match[:, 1]]
        points, angle = triangulate_pair(self._camera, j_from_i, pixels_a, pixels_b)
        seen = transform_points(j_from_i, points)
        limit = s.match_sigma_px * 2.5 * 1.2 ** np.maximum(a.octaves[match[:, 0]], b.octaves[match[:, 1]])
        off_a = np.linalg.norm(self._camera.pixel_from_point(points)[:, :2] - pixels_a, axis=1)
        off_b = np.linalg.norm(self._camera.pixel_from_point(seen)[:, :2] - pixels_b, axis=1)
        with np.errstate(invalid="ignore"):
            good = (off_a < limit) & (off_b < limit) & (angle > np.radians(s.min_angle_deg)) & (seen[:, 2] > 0)
        sigma = np.sqrt(2.0) * s.match_sigma_px / (self._camera.focal_px * angle[good])  # relative to the depth
        return (
            np.column_stack([match[good, 0], 1.0 / points[good, 2], sigma / points[good, 2]]),
            np.column_stack([match[good, 1], 1.0 / seen[good, 2], sigma / seen[good, 2]]),
        )

    def _with_depths(self, k: int, rows: Array) -> Keyframe:
        keyframe, focal_base = self._keyframes[k], self._camera.focal_px * self._camera.baseline_m
        fused = fuse_inverse_depths(rows, len(keyframe.features), self._settings.monocular.max_depth_sigma_share)
        disparities = focal_base * fused
        points = self._camera.point_from_pixel(keyframe.features.pixels, disparities[:, 0])
        return replace(keyframe, disparities=disparities, points_cam=points, from_views=True)


def with_single_cameras(
    odometry: OdometryPass, map_from_body: Array, rig: Rig, settings: SurveySettings
) -> OdometryPass:
    """Return the keyframes, at map_from_body (K, 4, 4), with depths in the images of a rig's single cameras beside the first one."""
    keyframes = odometry.keyframes
    for n, kind in enumerate(rig.kinds[1:]):
        if kind is not CameraKind.SINGLE:
            continue
        depths = MonoDepths([keyframe.others[n] for keyframe in keyframes], rig.camera, settings)
        seen = depths.keyframes_at(map_from_body @ rig.body_from_cam[1:][n])
        keyframes = [
            replace(keyframe, others=(*keyframe.others[:n], image, *keyframe.others[n + 1 :]))
            for keyframe, image in zip(keyframes, seen, strict=True)
        ]
    return odometry if keyframes is odometry.keyframes else replace(odometry, keyframes=keyframes)


def fuse_inverse_depths(rows: Array, count: int, max_sigma_share: float) -> Array:
    """Return (count, 2) inverse depth and sigma of each feature; NaN if too uncertain or if the keyframes disagree.

    rows (P, 3): feature, inverse depth, sigma. Values within three sigmas of the most accurate one are averaged with it, and a
    feature with more contradicting than supporting values is dropped.
    """
    out = np.full((count, 2), np.nan)
    order = np.lexsort((rows[:, 2], rows[:, 0]))
    features, values, sigmas = rows[order, 0].astype(np.int64), rows[order, 1], rows[order, 2]
    starts = np.flatnonzero(np.r_[True, features[1:] != features[:-1]]) if len(features) else np.zeros(0, np.int64)
    surest = np.repeat(starts, np.diff(np.r_[starts, len(features)]))
    agree = np.abs(values - values[surest]) < 3.0 * np.hypot(sigmas, sigmas[surest])
    weights = agree / sigmas**2
    total = np.bincount(features, weights, count)
    supported = 2 * np.bincount(features, agree, count) > np.bincount(features, minlength=count)
    with np.errstate(divide="ignore", invalid="ignore"):
        fused, sigma = np.bincount(features, weights * values, count) / total, 1.0 / np.sqrt(total)
    good = (total > 0) & supported & (sigma < max_sigma_share * fused)
    out[good] = np.column_stack([fused, sigma])[good]
    return out
