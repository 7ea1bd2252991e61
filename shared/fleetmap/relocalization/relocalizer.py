"""Relocalization of one frame: by projection near a predicted place, by recognized landmarks without a prediction. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import orb, stereo
from fleetmap.features.extraction import extract_in_slices
from fleetmap.features.matching import Packed, match_mutual, packed
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, Indices, Mask, length, se3_inverse
from fleetmap.pnp.pnp import Correspondences, PnpResult, pnp_with_rotation, ransac_pnp
from fleetmap.relocalization.alias_search import AliasCandidate, LandmarkSet, find_aliases
from fleetmap.relocalization.map_view import CovisibleLandmarks, MapView, Rows, most_similar, places_around
from fleetmap.relocalization.settings import STRONG_INLIERS, FixSettings, RelocalizerSettings
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Image
from fleetmap.time_sliced import TimeSliced


@dataclass(slots=True)
class FrameFeatures:
    """Features of one frame: pixels (N, 3) u_left v u_right, NaN where unknown.

    For a pair, depth is measured only for matched features, while `frame` is held; `is_tried` (N,) marks them.
    """

    features: orb.Features
    pixels: Array
    frame: RectifiedFrame | None = None
    is_tried: Mask | None = None

    @classmethod
    def of(
        cls, frame: RectifiedFrame, features: orb.Features, camera: StereoCamera, settings: StereoSettings
    ) -> "FrameFeatures":
        """Features of `frame`; depth of a pair is not measured yet, a depth image is read at once."""
        if frame.right is not None and frame.disparity_px is None:
            pixels = np.column_stack([features.pixels, np.full(len(features), np.nan)])
            return cls(features, pixels, frame, np.zeros(len(features), bool))
        return with_depth(frame, features, camera, settings)

    def packed(self) -> tuple[Array, Array, NDArray[np.int8], Packed]:
        """Features in the core's format."""
        features = self.features
        pixels, left = np.ascontiguousarray(self.pixels), np.ascontiguousarray(features.pixels, np.float64)
        return pixels, left, np.ascontiguousarray(features.octaves), packed(features.descriptors)

    def unmeasured(self) -> tuple[Image, Image, Array, Mask] | None:
        """The pair of images, and arrays that the core fills when it measures depth."""
        if self.frame is None or self.is_tried is None:
            return None
        assert self.frame.right is not None
        return self.frame.left, self.frame.right, self.pixels, self.is_tried

    def measured(self, rows: Indices, camera: StereoCamera, settings: StereoSettings) -> Array:
        """Pixels (P, 3) of some features; measures depth not tried before."""
        if self.frame is not None and self.is_tried is not None:
            at = rows[~self.is_tried[rows]]
            found = stereo.disparities(self.frame, camera, self.features.pixels[at], settings)
            self.pixels[at, 2] = self.pixels[at, 0] - found[:, 0]
            self.is_tried[at] = True
        return self.pixels[rows]

    def without_depth(self) -> "FrameFeatures":
        """A copy as of a single camera."""
        return FrameFeatures(self.features, np.column_stack([self.pixels[:, :2], np.full(len(self.pixels), np.nan)]))


def with_depth(
    frame: RectifiedFrame, features: orb.Features, camera: StereoCamera, settings: StereoSettings
) -> FrameFeatures:
    """Features of one frame with the depth of all; the frame itself is not kept."""
    found = stereo.disparities(frame, camera, features.pixels, settings)
    return FrameFeatures(features, np.column_stack([features.pixels, features.pixels[:, 0] - found[:, 0]]))


_RANKED = 8  # ratio of ranked to tried places
_TRIALS_AT_A_PLACE = 2
SAME_PLACE_M, _SAME_PLACE_COSINE = 1.2, 0.8  # less than half a bay: no look-alike place is so near
_MIN_RANSAC_SHARE = 0.15
_NEARLY_PX = 50.0  # beside the image: landmarks there count as in view for the search window


@dataclass(frozen=True, slots=True)
class Fix:
    """A verified pose of one frame.

    map_from_cam (4, 4); cov_rot_trans (6, 6) in map axes, rotation first; inliers, and image_coverage: number of image cells
    with inliers; inlier_share: of the final matches. matches (P, 2): features and landmarks, rows of the view, of the inliers.

    landmark_recall: share of inliers among the landmarks that the survey saw from nearby; 1 if none is expected.
    expected, seen: numbers of these landmarks and of the found ones; 0 if none is expected.
    alias_ratio: support of the best other place relative to this one; 1 if no other place was searched for.
    covisible: the landmarks behind landmark_recall, None if the survey did not pass here.
    matched: all final matches, before any gate. floor: whose map it is in, of a building; empty for the robot's own site.
    """

    map_from_cam: Array
    cov_rot_trans: Array
    inliers: int
    image_coverage: int
    inlier_share: float = 1.0
    landmark_recall: float = 1.0
    alias_ratio: float = 1.0
    expected: int = 0
    seen: int = 0
    matches: Indices | None = field(default=None, repr=False, compare=False)
    covisible: CovisibleLandmarks | None = field(default=None, repr=False, compare=False)
    matched: Correspondences | None = field(default=None, repr=False, compare=False)
    floor: str = ""


@dataclass(frozen=True, slots=True)
class EarlierFrame:
    """Features of a frame before that of a query: cam_from_query (4, 4) by odometry, covariance (6, 6) of that motion."""

    features: FrameFeatures
    cam_from_query: Array
    cov_rot_trans: Array


class Relocalizer:
    """Finds fixes of frames in one map view. floor: as of `Fix`."""

    def __init__(self, view: MapView, camera: StereoCamera, settings: RelocalizerSettings, floor: str = "") -> None:
        self.view, self.floor = view, floor
        self._camera = camera
        self._settings = settings
        self._finder = view.fix_finder(camera, settings)

    def extract(self, frame: RectifiedFrame) -> TimeSliced[FrameFeatures]:
        """Extract the features of one frame, in slices (see `finished`); the depth of a pair is not measured yet."""
        features = yield from extract_in_slices(frame.left, self._settings.orb, self._camera.clearance_px)
        return FrameFeatures.of(frame, features, self._camera, self._settings.stereo)

    def near(
        self, query: FrameFeatures, map_from_cam: Array, cov_rot_trans: Array, earlier: Sequence[EarlierFrame] = ()
    ) -> Fix | None:
        """Find the fix near a predicted pose whose covariance (map axes) sets the search window; None without agreement.

        earlier: other frames that count as well. Chance matches of several frames add up: so the fix must be reliable, and pose and
        motion known to within the smallest window. None otherwise.
        """
        rows, settings = self.view.visible(map_from_cam, self._camera, _NEARLY_PX, np.pi).rows, self._settings.fix
        if not len(rows):
            return None
        depth_m = float(np.median(np.linalg.norm(self.view.points_map[rows] - map_from_cam[:3, 3], axis=1)))
        radius = self._radius_px(depth_m, cov_rot_trans)
        if not earlier:
            return self.by_projection(query, map_from_cam, radius) if radius <= settings.max_radius_px else None
        known = [e for e in earlier if self._radius_px(depth_m, e.cov_rot_trans) <= settings.guided_radius_px]
        if not known or radius > settings.guided_radius_px:
            return None
        fix = self.by_projection(query, map_from_cam, radius, known)
        return fix if fix is not None and is_reliable(fix, settings) else None

    def anywhere(
        self,
        query: FrameFeatures,
        allowed: Mask | None = None,
        map_from_cam_rotation: Array | None = None,
        found: Sequence[Fix] = (),
        failed: list[Array] | None = None,
    ) -> TimeSliced[list[Fix]]:
        """Find verified fixes at all similar places, best first, duplicates removed; a slice for each place.

        allowed (K,): places that may be considered. map_from_cam_rotation: the orientation, if known. found: fixes of
        this frame that are already known, returned with the others. A place with a fix or failed trials already is not
        tried again, since it has the same landmarks. Places farther away are, since identical bays and aisles must compete.
        The aliases of the best fix are tried in any case.

        failed: map_from_cam of places that failed for earlier frames of this view; others are tried first, and those that
        fail now are appended. Cleared once no others are left.
        """
        settings = self._settings.fix
        fixes = [fix for k, fix in enumerate(found) if _is_new(fix, found[:k])]
        map_from_cam = self.view.map_from_cam
        at_fixes = sum((_at_place(map_from_cam, fix.map_from_cam) for fix in fixes), np.zeros(len(map_from_cam), int))
        trials, count = _TRIALS_AT_A_PLACE * at_fixes, 0  # at each place, its neighbourhood's too
        failed = [] if failed is None else failed
        max_trials = settings.top_places_found if fixes else settings.top_places
        for place in self._ranked(query, allowed, failed):
            if trials[place] >= _TRIALS_AT_A_PLACE:
                continue
            if count >= max_trials:
                break
            if count:
                yield
            count += 1
            trials += _at_place(map_from_cam, map_from_cam[place])
            fix = self.at_place(query, int(place), map_from_cam_rotation)
            if fix is None:
                failed.append(map_from_cam[place])
            elif _is_new(fix, fixes):
                fixes.append(fix)
                trials += _TRIALS_AT_A_PLACE * _at_place(map_from_cam, fix.map_from_cam)
        fixes.sort(key=lambda f: -f.inliers)
        if fixes:
            yield
            fixes = yield from self._with_aliases(query, fixes)
        return sorted(fixes, key=lambda f: -f.inliers)

    def by_projection(
        self, query: FrameFeatures, map_from_cam: Array, radius_px: float, earlier: Sequence[EarlierFrame] = ()
    ) -> Fix | None:
        """Find the fix by guided matching of all landmarks visible from a pose, twice: wide, then narrow around the first result.

        With earlier frames one pose is fitted to all, as a generalised camera, and a landmark counts once; matches are not returned.
        Sources: Pless 2003 and Kneip et al. 2013 (generalised cameras).
        """
        place = np.ascontiguousarray(map_from_cam)
        others = [
            (
                e.features.packed(),
                e.features.unmeasured(),
                np.ascontiguousarray(e.cam_from_query),
                *_sigmas(e.cov_rot_trans),
            )
            for e in earlier
        ]
        found = self._finder.by_projection(query.packed(), query.unmeasured(), place, radius_px, others)
        if found is None:
            return None
        view = self.view
        map_from_cam, covariance, cells, landmarks, features, rows, inliers, matched, covisible, is_found, is_passed = (
            found
        )
        seen = int(is_found.sum())
        fix = Fix(
            map_from_cam=map_from_cam,
            cov_rot_trans=covariance,
            inliers=landmarks,
            image_coverage=cells,
            inlier_share=float(inliers.mean()),
            landmark_recall=seen / max(len(covisible), 1),
            expected=len(covisible),
            seen=seen,
            floor=self.floor,
        )
        if earlier:
            return fix
        return replace(
            fix,
            matches=np.column_stack([features, rows])[inliers],
            covisible=CovisibleLandmarks(
                view.landmark_ids[covisible], view.points_map[covisible], view.descriptors[covisible], is_found
            )
            if is_passed
            else None,
            matched=Correspondences(self._camera, *matched),
        )

    def _ranked(self, query: FrameFeatures, allowed: Mask | None, failed: list[Array]) -> Rows:
        """Places to try, the most similar first; without failed ones and neighbourhoods of several failures, unless none else is left."""
        top, similarities = _RANKED * self._settings.fix.top_places, self.similarities(query)
        if not failed:
            return most_similar(similarities, allowed, top)
        map_from_cam = self.view.map_from_cam
        around = [_at_place(map_from_cam, place) for place in failed]
        is_tried = np.any([(map_from_cam == place).all(axis=(1, 2)) for place in failed], axis=0)
        is_open = ~is_tried & (np.sum(around, axis=0) < _TRIALS_AT_A_PLACE)
        is_wanted = is_open if allowed is None else allowed & is_open
        places = most_similar(similarities, is_wanted, top)
        if len(places):
            return places
        failed.clear()
        return most_similar(similarities, allowed, top)

    def similarities(self, query: FrameFeatures) -> Array:
        """Return (K,) how similar each place of the view is to a frame."""
        return self.view.similarities(query.features.descriptors)

    def at_place(self, query: FrameFeatures, place: int, rotation: Array | None) -> Fix | None:
        """Find the fix by recognized landmarks around one place; rotation (3, 3): the camera's in the map, None if unknown."""
        settings = self._settings.fix
        rows = self.view.neighbourhood(place)
        pairs = match_mutual(
            self.view.descriptors[rows], query.features.descriptors, settings.max_distance, settings.ratio
        )
        min_inliers = settings.min_inliers // 2
        if len(pairs) < min_inliers:
            return None
        matched = self._matched(query, pairs[:, 1], rows[pairs[:, 0]])
        found = None if rotation is None else self._with_rotation(matched, rotation, min_inliers)
        if found is None:
            found = self._by_ransac(matched)
            if found is None or found.inliers.sum() < _MIN_RANSAC_SHARE * len(pairs):
                return None
        fix = self.by_projection(query, se3_inverse(found.cam_from_source), settings.guided_radius_px)
        return None if fix is None else self._in_best_minimum(query, fix)

    def _in_best_minimum(self, query: FrameFeatures, fix: Fix) -> Fix:
        """Return the fix, or another solution with which more of its own matches agree.

        Nearly coplanar landmarks allow a second pose, rotated about the plane, a local minimum of least squares; its covariance
        does not include the first. Three-point solutions find both. Source: Schweighofer and Pinz 2006, on the two minima.
        """
        if fix.matched is None:
            return fix
        found = self._by_ransac(fix.matched)
        if found is None or found.inliers.sum() <= fix.inliers:
            return fix
        radius_px = self._settings.fix.guided_radius_px
        other = self.by_projection(query, se3_inverse(found.cam_from_source), radius_px)
        return other if other is not None and other.inliers > fix.inliers else fix

    def _with_aliases(self, query: FrameFeatures, fixes: list[Fix]) -> TimeSliced[list[Fix]]:
        """Return the fixes, and those at the aliases of the best one."""
        best = fixes[0]
        if best.matches is None:
            return fixes
        aliases = yield from self.aliases_of(query, best)
        fixes = [replace(best, alias_ratio=max((a.alias_ratio for a in aliases), default=0.0)), *fixes[1:]]
        for alias in aliases:
            if any(_at_place(fix.map_from_cam[None], alias.map_from_cam).any() for fix in fixes):
                continue
            yield
            fix = self.at_alias(query, alias, best)
            if fix is not None and _is_new(fix, fixes):
                fixes.append(fix)
        return fixes

    def aliases_of(self, query: FrameFeatures, fix: Fix) -> TimeSliced[list[AliasCandidate]]:
        """Return the places that look like that of a fix with matches, best first."""
        assert fix.matches is not None
        settings, view = self._settings.fix, self.view
        features, rows = fix.matches.T
        seen = LandmarkSet(view.points_map[rows], query.features.descriptors[features])
        landmarks = LandmarkSet(view.points_map, view.descriptors)
        limits = settings.alias_votes_share, settings.most_aliases
        return (yield from find_aliases(seen, landmarks, fix.map_from_cam, *limits))

    def at_alias(self, query: FrameFeatures, alias: AliasCandidate, seen: Fix) -> Fix | None:
        """Find the fix at an alias of another one, `seen`, with matches."""
        assert seen.matches is not None
        settings = self._settings.fix
        matched = self._matched(query, seen.matches[alias.features, 0], alias.landmarks)
        found = self._with_rotation(matched, alias.map_from_cam[:3, :3], settings.min_inliers // 3)
        if found is None:
            return self.by_projection(query, alias.map_from_cam, settings.max_radius_px)
        return self.by_projection(query, se3_inverse(found.cam_from_source), settings.guided_radius_px)

    def _by_ransac(self, matched: Correspondences) -> PnpResult | None:
        settings, seed = self._settings.fix, self._settings.seed
        return ransac_pnp(matched, threshold_px=settings.ransac_px, min_inliers=settings.min_inliers // 2, seed=seed)

    def _with_rotation(
        self, matched: Correspondences, map_from_cam_rotation: Array, min_inliers: int
    ) -> PnpResult | None:
        sigma_rad = self._settings.fix.rotation_sigma_rad
        return pnp_with_rotation(
            matched,
            map_from_cam_rotation.T,
            threshold_px=2 * self._settings.fix.ransac_px + sigma_rad * self._camera.focal_px,
            min_inliers=min_inliers,
            rotation_sigma_rad=sigma_rad,
        )

    def _matched(self, query: FrameFeatures, features: Indices, rows: Rows) -> Correspondences:
        """Points (P, 3) of landmarks and their matching features, for an unknown camera pose."""
        settings = self._settings
        measured = query.measured(features, self._camera, settings.stereo)
        scale = orb.SCALE_FACTOR ** np.minimum(query.features.octaves[features], 5).astype(np.float64)
        sigmas = settings.fix.feature_sigma_px * scale
        both = np.column_stack([sigmas, np.maximum(sigmas, 1.0)])
        return Correspondences(self._camera, self.view.points_map[rows], measured, both)

    def _radius_px(self, depth_m: float, cov_rot_trans: Array) -> float:
        """Three sigmas of the predicted pixel of a landmark at a distance."""
        angle, position = _sigmas(cov_rot_trans)
        three_sigmas_px = 3.0 * self._camera.focal_px * (position / max(depth_m, 0.5) + angle)
        return max(self._settings.fix.guided_radius_px, three_sigmas_px)


def is_reliable(fix: Fix, settings: FixSettings, strong_inliers: int = STRONG_INLIERS) -> bool:
    """True if a fix may determine the place: not with few landmarks if most of those expected there were not seen.

    Racks repeat: some landmarks of any rack agree with some of any other.
    """
    has_recall = fix.inliers >= settings.min_inliers and fix.landmark_recall >= settings.min_recall
    return fix.inliers >= strong_inliers or has_recall


def _sigmas(cov_rot_trans: Array) -> tuple[float, float]:
    """The largest sigmas of rotation and position."""
    widest = np.linalg.eigvalsh(np.stack([cov_rot_trans[:3, :3], cov_rot_trans[3:, 3:]]))[:, -1]
    rotation, position = np.sqrt(np.maximum(widest, 0.0))
    return float(rotation), float(position)


def _at_place(places_map_from_cam: Array, map_from_cam: Array) -> Mask:
    """Return (K,) which places (K, 4, 4) have mostly the same neighbourhood as a camera."""
    return places_around(places_map_from_cam, map_from_cam, SAME_PLACE_M, _SAME_PLACE_COSINE)


def _is_new(fix: Fix, others: Sequence[Fix]) -> bool:
    """True if no other fix lies within 0.5 m and 10 degrees."""
    own = fix.map_from_cam
    near = [o.map_from_cam for o in others if length(own[:3, 3] - o.map_from_cam[:3, 3]) < 0.5]
    return not any(0.5 * (np.trace(own[:3, :3].T @ other[:3, :3]) - 1) > np.cos(np.radians(10)) for other in near)
