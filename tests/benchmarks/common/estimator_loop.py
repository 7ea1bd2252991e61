"""Odometry and localization fed by `support.estimator.simulated_run` instead of pictures.

The loop is closed here because the simulator and the estimators may not know each other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.features import orb
from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse, transform_points
from fleetmap.mapformat.tile import Tile
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.settings import OdometrySettings, TrackerSettings
from fleetmap.odometry.tracking.tracker import MotionSince, Tracked, Tracker
from fleetmap.pnp.pnp import Correspondences, PnpResult, ransac_pnp, refine_pnp
from fleetmap.relocalization.map_view import LookAlikes, MapView
from fleetmap.relocalization.relocalizer import FrameFeatures, Relocalizer
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import MountedCamera, MountedRig, OtherView, RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import CameraFrame, PositionPrior, wheel_between
from fleetmap.time_sliced import TimeSliced
from locclient.localization.estimate import Estimate
from locclient.localization.held_maps import HeldMap
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings
from support.estimator.simulated_run import EstimatorSession, Found
from support.worlds.vocabulary_training import train_vocabulary

SETTINGS = LocalizerSettings()
_TILE_M = 1024.0
_LEAD_NS = 30_000_000  # by which IMU and wheels are ahead of the frame that is handled, for stamps that are too early
_EVERY_M, _EVERY_RAD = 0.4, 0.2
_NOISE = np.random.default_rng(0).integers(0, 255, (7, 48, 64), np.uint8)


class EstimatorTracker(Tracker):
    """The tracker with its eyes replaced: flow, disparities and corners come from a session, the motion is found as the core finds it.

    Track ids are the landmarks'. After a gap the flow simply goes on.
    """

    def __init__(
        self, session: EstimatorSession, camera: StereoCamera, settings: TrackerSettings, first_frame: int = 0
    ) -> None:
        super().__init__(camera, settings, first_frame=first_frame)
        self._session = session
        self._ids, self._pixels = np.zeros(0, np.int64), np.zeros((0, 3))
        self._begun_px: dict[int, Array] = {}

    def track(
        self, frame: RectifiedFrame, motion_since: MotionSince, rotation_sigma_rad: float | None = None
    ) -> Tracked:
        """As the tracker's; frames must come one by one from the session's first."""
        self._frame_index += 1
        motion, information, share = None, None, 1.0
        if self._frame_index:
            guess = motion_since(self._frame_index - 1)
            found, share = self._follow(np.eye(4) if guess is None else guess)
            if found is not None:
                motion, information = found.cam_from_source, found.information
        self._add_corners()
        ids, pixels = self._ids.copy(), self._pixels.copy()
        return Tracked(ids, pixels, (), motion, share, by_descriptors=False, information=information)

    def _measure(self, ids: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        begun = np.array([self._begun_px[number] for number in ids.tolist()]).reshape(-1, 2)
        return self._session.follow(self._frame_index, ids.astype(np.uint64), begun)

    def _follow(self, guess: Array) -> tuple[PnpResult | None, float]:
        before, (pixels, kept) = self._pixels, self._measure(self._ids)
        has_depth = self._camera.baseline_m > 0
        disparities = before[:, 0] - before[:, 2] if has_depth else np.full(len(before), np.nan)
        points_cam = self._camera.point_from_pixel(before[:, :2], disparities)
        known = kept & np.isfinite(points_cam).all(axis=1)
        found, followed = self._motion(points_cam[known], pixels[known, :2], guess), max(int(kept.sum()), 1)
        if found is not None:
            expected = self._camera.pixel_from_point(transform_points(found.cam_from_source, points_cam))
            near = np.linalg.norm((expected - pixels)[:, :2], axis=1) < self._settings.ransac_px
            kept = kept & (near | ~known)
        self._ids, self._pixels = self._ids[kept], pixels[kept]
        return found, float(kept.sum()) / followed

    def _motion(self, points_cam: Array, places: Array, guess: Array) -> PnpResult | None:
        count, least = len(points_cam), self._settings.min_inliers
        if count < least:
            return None
        measured = np.column_stack([places, np.full(count, np.nan)])
        matches = Correspondences(self._camera, points_cam, measured, np.ones((count, 2)))
        refined = refine_pnp(matches, guess)
        if refined is not None and refined.inliers.sum() > 0.6 * count:
            return refined
        limits = {"threshold_px": self._settings.ransac_px, "min_inliers": least, "iterations": 200}
        searched = ransac_pnp(matches, **limits, seed=count)  # type: ignore[arg-type]
        best = max((each for each in (refined, searched) if each), key=lambda each: each.inliers.sum(), default=None)
        return best if best is not None and best.inliers.sum() >= least else None

    def _add_corners(self) -> None:
        missing = self._settings.max_points - len(self._ids)
        if missing < 0.15 * self._settings.max_points:
            return
        distance_px = self._settings.min_distance_px
        wanted, begun = self._session.corners(self._frame_index, self._pixels, missing, distance_px)
        is_new = ~np.isin(wanted.astype(np.int64), self._ids)
        ids = wanted[is_new].astype(np.int64)
        held = {number: self._begun_px[number] for number in self._ids.tolist()}
        self._begun_px = held | dict(zip(ids.tolist(), begun[is_new], strict=True))
        pixels, kept = self._measure(ids)
        ids, pixels = np.concatenate([self._ids, ids[kept]]), np.concatenate([self._pixels, pixels[kept]])
        rising = np.argsort(ids)  # as those of the tracker, which numbers them one after another
        self._ids, self._pixels = ids[rising], pixels[rising]


def seen(session: EstimatorSession, frame: int) -> FrameFeatures:
    """What Relocalizer.extract would have made of the picture."""
    found = session.features(frame)
    angles = np.zeros(len(found.rows), np.float32)
    return FrameFeatures(
        orb.Features(found.pixels[:, :2].copy(), found.octaves, angles, found.descriptors), found.pixels
    )


def blank(session: EstimatorSession, frame: int, others: Sequence[EstimatorSession] = ()) -> RectifiedFrame:
    """A frame that carries its stamp alone: noise for the judge of pictures, nothing at all where nothing is to be seen."""
    is_dark = not len(session.sighting(frame).ids)
    left = np.zeros_like(_NOISE[0]) if is_dark else _NOISE[frame % len(_NOISE)]
    views = tuple(_Blank.of(blank(other, frame)) for other in others)
    return RectifiedFrame(session.stamps_ns[frame], left, None, None, views)


@dataclass(frozen=True)
class _Blank(OtherView):
    """A view of which nothing is rectified."""

    frame: RectifiedFrame

    @classmethod
    def of(cls, frame: RectifiedFrame) -> "_Blank":
        return cls(CameraFrame(frame.stamp_ns, frame.left), None, frame)  # type: ignore[arg-type]

    @property
    def rectified(self) -> RectifiedFrame:  # type: ignore[override]
        return self.frame


def odometry_of(
    session: EstimatorSession, settings: OdometrySettings, calibration: RigCalibration | None = None
) -> Odometry:
    """The odometry of a session's first camera; `calibration` in the place of the rig's nominal one."""
    nominal, mounted = calibration or session.session.nominal, MountedCamera(session.camera, session.body_from_cam)
    odometry = Odometry(MountedRig(nominal, (mounted,), nominal.cameras[0].imu_minus_cam_s), settings)
    odometry._tracker = EstimatorTracker(session, session.camera, settings.tracker)
    return odometry


def run_odometry(
    session: EstimatorSession, frames: int | None = None, calibration: RigCalibration | None = None,
    settings: OdometrySettings | None = None,
) -> list[OdometryEstimate]:  # fmt: skip
    """The odometry's estimates over a session; `calibration` in the place of the rig's nominal one."""
    odometry = odometry_of(session, settings or OdometrySettings(), calibration)
    estimates, last_ns = [], 0
    for frame in range(len(session) if frames is None else min(frames, len(session))):
        until_ns = session.stamps_ns[frame] + _LEAD_NS
        odometry.handle_imu(session.session.imu.between(last_ns, until_ns))
        odometry.handle_wheel(wheel_between(session.session.wheel, last_ns, until_ns))
        last_ns = until_ns
        estimates.append(odometry.handle_stereo(blank(session, frame)))
    return estimates


@dataclass
class Observed:
    """The sightings of one landmark: where it was seen from (unit vectors), up to which distance it would be found, its descriptors."""

    point_map: Array
    directions: list[Array] = field(default_factory=list)
    reaches_m: list[float] = field(default_factory=list)
    descriptors: list[NDArray[np.uint8]] = field(default_factory=list)


def is_new_place(last_map_from_cam: Array, map_from_cam: Array, every_m: float = _EVERY_M) -> bool:
    """Whether a map holds one more place here."""
    since = se3_inverse(last_map_from_cam) @ map_from_cam
    return bool(np.linalg.norm(since[:3, 3]) >= every_m or rotation_angle_rad(since[:3, :3]) >= _EVERY_RAD)


def survey_map(
    session: EstimatorSession, rng: np.random.Generator, *, every_m: float = _EVERY_M, sigma_m: float = 0.01,
    others: Sequence[EstimatorSession] = (),
) -> tuple[list[Tile], Vocabulary]:  # fmt: skip
    """A map as a survey would have left it: landmarks found at least twice, with an error of sigma_m, a place each every_m.

    The vocabulary is trained on its descriptors. others: the rig's other views.
    """
    observed: dict[int, Observed] = {}
    places: list[tuple[Array, list[int]]] = []
    for view in (session, *others):
        _add_places(view, every_m, observed, places)
    return tile_of(observed, places, rng, sigma_m)


def _add_places(
    session: EstimatorSession, every_m: float, observed: dict[int, Observed], places: list[tuple[Array, list[int]]]
) -> None:
    """Add what a view shows along the session's drive."""
    first = len(places)
    for frame in range(len(session)):
        map_from_cam = session.map_from_body[frame] @ session.body_from_cam
        if len(places) > first and not is_new_place(places[-1][0], map_from_cam, every_m):
            continue
        sighting, found = session.sighting(frame), session.features(frame)
        members = []
        points = _features_map(session, frame, found)
        for feature in np.flatnonzero(found.rows >= 0).tolist():
            row = int(found.rows[feature])
            landmark = int(sighting.ids[row])
            entry = observed.setdefault(landmark, Observed(points[feature]))
            away = map_from_cam[:3, 3] - sighting.points_map[row]
            entry.directions.append(away / np.linalg.norm(away))
            entry.reaches_m.append(float(sighting.distances_m[row]) * orb.SCALE_FACTOR ** float(found.octaves[feature]))
            entry.descriptors.append(found.descriptors[feature])
            members.append(landmark)
        places.append((map_from_cam, members))


def _features_map(session: EstimatorSession, frame: int, found: Found) -> Array:
    """(N, 3) what features show: at the landmark's true depth, but through the pixel where it was found."""
    exact = session.sighting(frame).pixels[found.rows]
    points_cam = session.camera.point_from_pixel(found.pixels[:, :2], exact[:, 0] - exact[:, 2])
    return transform_points(session.map_from_body[frame] @ session.body_from_cam, points_cam)


def tile_of(
    observed: dict[int, Observed], places: list[tuple[Array, list[int]]], rng: np.random.Generator, sigma_m: float
) -> tuple[list[Tile], Vocabulary]:
    """The map of all landmarks that were seen at least twice, with an error of sigma_m added to each."""
    kept = sorted(landmark for landmark, entry in observed.items() if len(entry.descriptors) >= 2)
    number = {landmark: index for index, landmark in enumerate(kept)}
    entries = [observed[landmark] for landmark in kept]
    directions = np.array([np.mean(entry.directions, axis=0) for entry in entries])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    half = [
        np.arccos(np.clip((np.array(e.directions) @ d).min(), -1, 1)) for e, d in zip(entries, directions, strict=True)
    ]
    points = np.array([entry.point_map for entry in entries]) + rng.normal(0.0, sigma_m, (len(entries), 3))
    descriptors = np.array([entry.descriptors[len(entry.descriptors) // 2] for entry in entries])
    lists = tuple(np.array(sorted({number[i] for i in members if i in number}), np.uint32) for _, members in places)
    tile = Tile(
        0, 0, _TILE_M, np.arange(len(kept), dtype=np.uint32), np.clip(points, 0.0, _TILE_M), descriptors,
        directions.astype(np.float32), np.array(half, np.float32),
        np.array([np.median(entry.reaches_m) for entry in entries], np.float32), np.full(len(kept), sigma_m, np.float32),
        np.arange(len(places), dtype=np.uint32), np.array([placed for placed, _ in places]), lists,
    )  # fmt: skip
    images = np.zeros(len(kept), np.int64)
    for place, ids in enumerate(lists):
        images[ids] = place
    return [tile], train_vocabulary(descriptors, 10, 4, rng, images)


class SessionRelocalizer(Relocalizer):
    """A relocalizer with its eyes replaced: what a frame shows comes from a session. One view serves many of them."""

    def __init__(self, view: MapView, session: EstimatorSession, settings: LocalizerSettings) -> None:
        super().__init__(view, session.camera, settings.relocalizer)
        self._session = session
        self._index_of = {stamp: index for index, stamp in enumerate(session.stamps_ns)}

    def extract(self, frame: RectifiedFrame) -> TimeSliced[FrameFeatures]:
        """As the relocalizer's."""
        yield
        return seen(self._session, self._index_of[frame.stamp_ns])


def run_localizer(
    session: EstimatorSession, view: MapView, prior: PositionPrior | None = None, frames: int | None = None, *,
    has_wheels: bool = False, settings: LocalizerSettings = SETTINGS, until: Callable[[Estimate], bool] = lambda _: False,
    lookalikes: LookAlikes | None = None, others: Sequence[EstimatorSession] = (),
    priors: Callable[[int], Sequence[PositionPrior]] = lambda _: (),
) -> list[Estimate]:  # fmt: skip
    """The localizer's estimates over a session in a map; the last one is that for which `until` holds. others: the rig's other views.
    priors: those before each frame."""
    nominal, views = session.session.nominal, (session, *others)
    mounted = tuple(MountedCamera(view.camera, view.body_from_cam) for view in views)
    localizer = Localizer(MountedRig(nominal, mounted, nominal.cameras[0].imu_minus_cam_s), settings)

    def new_tracker(first_frame: int, first_id: int) -> Tracker:
        followed = views[localizer.perception.odometry._rig.followed]
        return EstimatorTracker(followed, followed.camera, settings.odometry.tracker, first_frame)

    localizer.perception.odometry._new_tracker = new_tracker  # type: ignore[method-assign]
    localizer.perception.odometry._tracker = new_tracker(0, 0)
    localizer.maps.by_floor[""] = HeldMap(
        1, tuple(SessionRelocalizer(view, each, settings) for each in views), lookalikes
    )
    if prior is not None:
        localizer.handle_prior(prior)
    estimates, last_ns = [], 0
    for frame in range(len(session) if frames is None else min(frames, len(session))):
        stamp_ns = session.stamps_ns[frame]
        localizer.handle_imu(session.session.imu.between(last_ns, stamp_ns + 1))
        if has_wheels:
            localizer.handle_wheel(wheel_between(session.session.wheel, last_ns, stamp_ns + 1))
        last_ns = stamp_ns + 1
        for told in priors(frame):
            localizer.handle_prior(told)
        estimates.append(localizer.handle_stereo(blank(session, frame, others)))
        if until(estimates[-1]):
            break
    return estimates


def relative_errors_m(estimates: list[OdometryEstimate], map_from_body: Array) -> Array:
    """(N,) errors of the motion over 15 frames, of estimates that know gravity."""
    step = 15
    known = [k for k in range(len(estimates) - step) if estimates[k].inertial]
    errors = []
    for k in known:
        moved = se3_inverse(estimates[k].odom_from_body) @ estimates[k + step].odom_from_body
        truly = se3_inverse(map_from_body[k]) @ map_from_body[k + step]
        errors.append(float(np.linalg.norm(moved[:3, 3] - truly[:3, 3])))
    return np.array(errors)
