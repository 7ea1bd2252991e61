"""One frame placed in the map: by projection where it nearly is, by words where it might be anywhere. Pure."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import orb, stereo
from fleetmap.features.matching import match_by_projection, match_mutual
from fleetmap.geometry import Array, se3_inverse
from fleetmap.pnp.pnp import PnpResult, pnp_with_rotation, ransac_pnp, refine_pnp
from fleetmap.relocalization.alias_search import AliasCandidate, find_aliases
from fleetmap.relocalization.map_view import Expected, MapView, Rows
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera

_NEIGHBOURHOOD_M = 3.0
_RANKED = 8  # so many times as many places are ranked as are tried
_TRIALS_AT_A_PLACE = 2
_FIRST_DOUBT = 3.0  # of the sigmas, while the place that matches were looked for around is only a guess
_SAME_PLACE_M, _SAME_PLACE_COSINE = 1.2, 0.8  # less than half a bay: no other place looks so much the same so near

T = TypeVar("T")
TimeSliced = Generator[None, None, T]  # work that may be interrupted wherever it yields


@dataclass(frozen=True, slots=True)
class Fix:
    """A verified place of one frame.

    map_from_cam (4, 4); cov_rot_trans (6, 6) in map axes, rotation first; inliers and the cells of the image that hold them;
    share of the inliers among what was matched at the end. matches (P, 2): features and landmarks, rows of the view, of the inliers.

    landmark_recall: share of the landmarks seen by the survey from next to there that are inliers; 1 where none is expected.
    expected, seen: how many landmarks that is a share of, and how many were found; 0 where none is expected.
    alias_ratio: support of the best other place relative to this one; 1 where no other place was searched for.
    witnessed: the landmarks behind landmark_recall, None where the survey did not pass.
    """

    map_from_cam: Array
    cov_rot_trans: Array
    inliers: int
    cells: int
    share: float = 1.0
    landmark_recall: float = 1.0
    alias_ratio: float = 1.0
    expected: int = 0
    seen: int = 0
    matches: NDArray[np.int64] | None = field(default=None, repr=False, compare=False)
    witnessed: Expected | None = field(default=None, repr=False, compare=False)


@dataclass(slots=True)
class Seen:
    """Features of one frame: pixels (N, 3) u_left v u_right, NaN where unknown.

    Depth is measured only for features that match something, while `frame` is held: `asked` (N,) says for which it was tried.
    """

    features: orb.Features
    pixels: Array
    frame: RectifiedFrame | None = None
    asked: NDArray[np.bool_] | None = None


class Relocalizer:
    """Finds fixes of frames in one map view."""

    def __init__(self, view: MapView, camera: StereoCamera, settings: RelocalizerSettings) -> None:
        self.view = view
        self._camera = camera
        self._settings = settings

    def look(self, frame: RectifiedFrame) -> TimeSliced[Seen]:
        """What one frame shows, in slices: see `finished`."""
        features = yield from orb.detect_in_slices(frame.left, self._settings.orb)
        pixels = np.column_stack([features.pixels, np.full(len(features), np.nan)])
        return Seen(features, pixels, frame, np.zeros(len(features), bool))

    def _measured(self, seen: Seen, index: NDArray[np.int64], prior_px: Array | None = None) -> Array:
        """Pixels (P, 3) of features `index`, depth measured now where it was not asked for before; prior_px (P,) narrows the search."""
        if seen.frame is not None and seen.asked is not None:
            new = np.flatnonzero(~seen.asked[index])
            at = index[new]
            prior = None if prior_px is None else prior_px[new]
            found = stereo.disparities(seen.frame, self._camera, seen.features.pixels[at], self._settings.stereo, prior)
            seen.pixels[at, 2] = seen.pixels[at, 0] - found[:, 0]
            seen.asked[at] = True
        return seen.pixels[index]

    def near(self, seen: Seen, map_from_cam: Array, cov_rot_trans: Array) -> Fix | None:
        """The fix near a predicted place whose covariance (map axes) sets the search window; None where nothing agrees."""
        radius = self._radius_px(map_from_cam, cov_rot_trans)
        if radius > self._settings.fix.max_radius_px:
            return None
        return self._by_projection(seen, map_from_cam, radius)

    def anywhere(
        self, seen: Seen, allowed: NDArray[np.bool_] | None = None, map_from_cam_rotation: Array | None = None,
        found: Sequence[Fix] = (),
    ) -> TimeSliced[list[Fix]]:  # fmt: skip
        """Fixes of all places that look like this one and verify, best first, duplicates removed; a slice for each place.

        allowed (K,): places that may be considered. map_from_cam_rotation: the orientation, where it is known. found: fixes of
        this frame that are known already, returned with the others. A place
        that a fix or a failed trial already stands at is not tried again: it is made of the same landmarks. One further on is,
        since identical bays and aisles must be able to speak against each other; what looks the same as the best fix anywhere in
        the map is tried in any case.
        """
        settings = self._settings.fix
        fixes = [fix for k, fix in enumerate(found) if all(not _same(fix, other) for other in found[:k])]
        tried: list[Array] = []
        most = settings.top_places_found if fixes else settings.top_places
        for place in self.view.similar_places(seen.features.descriptors, allowed, _RANKED * settings.top_places):
            map_from_place = self.view.map_from_cam[place]
            if any(_stands_at(fix.map_from_cam, map_from_place) for fix in fixes):
                continue
            if sum(_stands_at(other, map_from_place) for other in tried) >= _TRIALS_AT_A_PLACE:
                continue
            if len(tried) >= most:
                break
            if tried:
                yield
            tried.append(map_from_place)
            fix = self._at_place(seen, int(place), map_from_cam_rotation)
            if fix is not None and all(not _same(fix, other) for other in fixes):
                fixes.append(fix)
        fixes.sort(key=lambda f: -f.inliers)
        if fixes:
            yield
            fixes = yield from self._with_twins(seen, fixes)
        return sorted(fixes, key=lambda f: -f.inliers)

    def _with_twins(self, seen: Seen, fixes: list[Fix]) -> TimeSliced[list[Fix]]:
        """The fixes, and those at the twins of the best one."""
        settings, best = self._settings.fix, fixes[0]
        if best.matches is None:
            return fixes
        features, rows = best.matches.T
        twins = yield from find_aliases(
            seen.features.descriptors[features], self.view.points_map[rows], self.view.descriptors, self.view.points_map,
            best.map_from_cam, settings.twin_votes_share, settings.most_twins,
        )  # fmt: skip
        fixes = [replace(best, alias_ratio=max((twin.share for twin in twins), default=0.0)), *fixes[1:]]
        for twin in twins:
            if any(_stands_at(fix.map_from_cam, twin.map_from_cam) for fix in fixes):
                continue
            yield
            fix = self._at_twin(seen, twin, features)
            if fix is not None and all(not _same(fix, other) for other in fixes):
                fixes.append(fix)
        return fixes

    def _at_twin(self, seen: Seen, twin: AliasCandidate, features: NDArray[np.int64]) -> Fix | None:
        settings = self._settings.fix
        index = features[twin.features]
        found = pnp_with_rotation(
            self._camera, self.view.points_map[twin.landmarks], self._measured(seen, index),
            self._sigmas(seen, index, twin.landmarks, None), twin.map_from_cam[:3, :3].T,
            threshold_px=2 * settings.ransac_px + settings.rotation_sigma_rad * self._camera.focal_px,
            min_inliers=settings.min_inliers // 3, rotation_sigma_rad=settings.rotation_sigma_rad,
        )  # fmt: skip
        map_from_cam = twin.map_from_cam if found is None else se3_inverse(found.cam_from_source)
        return self._by_projection(
            seen, map_from_cam, settings.max_radius_px if found is None else settings.guided_radius_px
        )

    def _at_place(self, seen: Seen, place: int, rotation: Array | None) -> Fix | None:
        settings = self._settings.fix
        rows = self.view.neighbourhood(place, _NEIGHBOURHOOD_M)
        pairs = match_mutual(
            self.view.descriptors[rows], seen.features.descriptors, settings.max_distance, settings.ratio
        )
        if len(pairs) < settings.min_inliers // 2:
            return None
        points, pixels = self.view.points_map[rows[pairs[:, 0]]], self._measured(seen, pairs[:, 1])
        sigmas = self._sigmas(seen, pairs[:, 1], rows[pairs[:, 0]], None)
        wide_px = 2 * settings.ransac_px + settings.rotation_sigma_rad * self._camera.focal_px
        found: PnpResult | None = None
        if rotation is not None:
            found = pnp_with_rotation(
                self._camera, points, pixels, sigmas, rotation.T, threshold_px=wide_px,
                min_inliers=settings.min_inliers // 2, rotation_sigma_rad=settings.rotation_sigma_rad,
            )  # fmt: skip
        if found is None:
            found = ransac_pnp(
                self._camera, points, pixels, sigmas, threshold_px=settings.ransac_px, min_inliers=settings.min_inliers // 2,
                seed=self._settings.seed,
            )  # fmt: skip
            if found is None or found.inliers.sum() < 0.15 * len(pairs):
                return None
        return self._by_projection(seen, se3_inverse(found.cam_from_source), settings.guided_radius_px)

    def _by_projection(self, seen: Seen, map_from_cam: Array, radius_px: float) -> Fix | None:
        """Guided matching of all visible landmarks around a place, twice: wide, then narrow around the first answer."""
        settings = self._settings.fix
        found: PnpResult | None = None
        matches: NDArray[np.int64] = np.zeros((0, 2), np.int64)
        for radius, doubt in ((radius_px, _FIRST_DOUBT), (min(radius_px, settings.guided_radius_px) * 0.6, 1.0)):
            rows, pixels, octaves = self.view.visible(
                map_from_cam, self._camera, radius, np.radians(settings.max_view_angle_deg)
            )
            if len(rows) < settings.min_inliers:
                return None
            span = np.column_stack([np.floor(octaves) - 2, np.ceil(octaves) + 2]).astype(np.int64)
            window = radius * orb.SCALE_FACTOR ** np.clip(octaves, 0, 3)
            hit, _ = match_by_projection(
                pixels[:, :2], window, self.view.descriptors[rows], span, seen.features.pixels, seen.features.octaves,
                seen.features.descriptors, settings.guided_distance, settings.guided_ratio,
            )  # fmt: skip
            kept = np.flatnonzero(hit >= 0)
            if len(kept) < settings.min_inliers:
                return None
            points = self.view.points_map[rows[kept]]
            sigmas = doubt * self._sigmas(seen, hit[kept], rows[kept], map_from_cam)
            measured = self._measured(seen, hit[kept], pixels[kept, 0] - pixels[kept, 2])
            found = refine_pnp(self._camera, points, measured, sigmas, se3_inverse(map_from_cam))
            if found is None or found.inliers.sum() < settings.min_inliers:
                return None
            map_from_cam = se3_inverse(found.cam_from_source)
            matches = np.column_stack([hit[kept], rows[kept]])[found.inliers]
        assert found is not None
        return self._verified(seen, found, matches)

    def _verified(self, seen: Seen, found: PnpResult, matches: NDArray[np.int64]) -> Fix | None:
        settings, features = self._settings.fix, matches[:, 0]
        pixels = seen.pixels[features]
        column = np.clip(pixels[:, 0] / self._camera.width_px * 8, 0, 7).astype(int)
        row = np.clip(pixels[:, 1] / self._camera.height_px * 6, 0, 5).astype(int)
        cells = len(np.unique(column * 6 + row))
        share = float(found.inliers.mean())
        if cells < settings.min_cells or share < 0.35:
            return None
        map_from_cam = se3_inverse(found.cam_from_source)
        rotation = map_from_cam[:3, :3]
        carry = np.zeros(
            (6, 6)
        )  # left perturbation in camera axes -> rotation about the camera's place and its position, map axes
        carry[:3, :3] = carry[3:, 3:] = -rotation
        covariance = settings.covariance_scale * carry @ found.cov_rot_trans @ carry.T
        covariance += np.diag([settings.floor_rad**2] * 3 + [settings.floor_m**2] * 3)
        witnessed, is_passed = self.view.witnessed(map_from_cam, self._camera)
        is_hit = np.isin(witnessed, matches[:, 1])
        hits = int(is_hit.sum())
        told = self.view.expected(witnessed, is_hit) if is_passed else None
        return Fix(
            map_from_cam, covariance, int(found.inliers.sum()), cells, share, hits / max(len(witnessed), 1),
            expected=len(witnessed), seen=hits, matches=matches, witnessed=told,
        )  # fmt: skip

    def _sigmas(self, seen: Seen, features: NDArray[np.int64], rows: Rows, map_from_cam: Array | None) -> Array:
        """(N, 2): of pixels and of disparities, by octave and by the landmarks' own uncertainty.

        That lies along the direction from which a landmark was mapped: seen from there it hardly shows, from aside it does.
        """
        settings = self._settings.fix
        scale = orb.SCALE_FACTOR ** np.minimum(seen.features.octaves[features], 5).astype(np.float64)
        base = settings.feature_sigma_px * scale
        if map_from_cam is None:
            return np.column_stack([base, np.maximum(base, 1.0)])
        rays = self.view.points_map[rows] - map_from_cam[:3, 3]
        distances = np.linalg.norm(rays, axis=1)
        along = np.abs((rays * self.view.view_directions_map[rows]).sum(axis=1)) / distances
        off_px = self._camera.focal_px * self.view.sigmas_m[rows] / distances
        across_px = off_px * np.sqrt(np.maximum(1.0 - along**2, 0.0))
        depth_px = off_px * along * self._camera.baseline_m / distances
        return np.column_stack(
            [np.hypot(base, np.minimum(across_px, 10.0)), np.hypot(settings.disparity_sigma_px, depth_px)]
        )

    def _radius_px(self, map_from_cam: Array, cov_rot_trans: Array) -> float:
        """Three sigmas of a landmark's predicted pixel, at the median distance of what should be visible."""
        rows, _, _ = self.view.visible(map_from_cam, self._camera, 50.0, np.pi)
        if not len(rows):
            return np.inf
        depth = float(np.median(np.linalg.norm(self.view.points_map[rows] - map_from_cam[:3, 3], axis=1)))
        position = float(np.sqrt(np.linalg.eigvalsh(cov_rot_trans[3:, 3:])[-1]))
        angle = float(np.sqrt(np.linalg.eigvalsh(cov_rot_trans[:3, :3])[-1]))
        return max(
            self._settings.fix.guided_radius_px, 3.0 * self._camera.focal_px * (position / max(depth, 0.5) + angle)
        )


def finished(work: TimeSliced[T]) -> T:
    """The result of work in slices, all of them at once."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            return cast(T, done.value)


def _stands_at(map_from_cam: Array, map_from_place: Array) -> bool:
    """Whether a place's neighbourhood is mostly that of a camera."""
    apart_m = float(np.linalg.norm(map_from_cam[:3, 3] - map_from_place[:3, 3]))
    axis, place_axis = map_from_cam[:3, 2], map_from_place[:3, 2]
    return apart_m < _SAME_PLACE_M and bool(axis @ place_axis > _SAME_PLACE_COSINE)


def _same(a: Fix, b: Fix) -> bool:
    cosine = 0.5 * (np.trace(a.map_from_cam[:3, :3].T @ b.map_from_cam[:3, :3]) - 1)
    return bool(np.linalg.norm(a.map_from_cam[:3, 3] - b.map_from_cam[:3, 3]) < 0.5 and cosine > np.cos(np.radians(10)))
