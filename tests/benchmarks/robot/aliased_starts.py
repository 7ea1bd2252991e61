"""Starts anywhere in aisles that look the same, estimator level: what the localizer says before and after motion decides."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.common import estimator_loop
from benchmarks.robot.standing_robot import standing
from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat.tile import Tile
from fleetmap.messages import Status
from fleetmap.relocalization.map_view import LookAlikes, MapView
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import PositionPrior, Trajectory
from fleetsim.recorder import Order, Session
from locclient.localization.estimate import Estimate
from locclient.localization.settings import LocalizerSettings, TrackSettings
from mapserver.drafting.draft_evidence import PROBES
from mapserver.quality.probes import Probe, fixes_of, starts_without_prior
from mapserver.survey.settings import BudgetSettings
from mapserver.survey.survey_map import SurveyMap
from mapserver.tiles.tiling import choose_landmarks
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession, Found, Ids, Sighting, Smudge, unpictured

RIGHT_M, WRONG_M = 0.5, 0.3
WHOLE_SITE = LocalizerSettings(track=TrackSettings(is_whole_site_mapped=True))
_EVERY_M = 0.8


class RememberingSession(EstimatorSession):
    """A session that looks at each frame once, however many starts go through it."""

    def __init__(self, session: Session, field: LandmarkField | None, smudge: Smudge | None = None) -> None:
        super().__init__(session, field=field, smudge=smudge)
        self.field = field
        self.sighting, self.features = cache(self.sighting), cache(self.features)


class LateSession(EstimatorSession):
    """A session from one of its frames on."""

    def __init__(self, whole: EstimatorSession, start: int) -> None:
        self.session, self.camera, self.body_from_cam = whole.session, whole.camera, whole.body_from_cam
        self.stamps_ns, self.map_from_body = whole.stamps_ns[start:], whole.map_from_body[start:]
        self._whole, self._start = whole, start

    def sighting(self, frame: int) -> Sighting:
        return self._whole.sighting(frame + self._start)

    def follow(self, frame: int, ids: Ids, begun_px: Array) -> tuple[Array, NDArray[np.bool_]]:
        return self._whole.follow(frame + self._start, ids, begun_px)

    def corners(self, frame: int, taken: Array, count: int, min_distance_px: float) -> tuple[Ids, Array]:
        return self._whole.corners(frame + self._start, taken, count, min_distance_px)

    def features(self, frame: int) -> Found:
        return self._whole.features(frame + self._start)


class Site(NamedTuple):
    """A robot's drive, and the map of a survey. lookalikes: what its build would have measured, None where it did not."""

    robot: RememberingSession
    tile: Tile
    view: MapView
    lookalikes: LookAlikes | None = None


def surveyed_site(scenario: str, seed: int, survey_run: str = "survey-both-ways", day: int = 0) -> Site:
    """The site of that seed, surveyed through every aisle both ways by default; the robot drives a day later, on day 0 the same day."""
    session = unpictured(Order(scenario, seed=seed, robot=survey_run, day=day))
    field = LandmarkField(session.world)
    survey = EstimatorSession(session, field=field)
    drive = unpictured(Order(scenario, seed=seed, robot="runner-1", day=day + 1 if day else 0))
    robot = RememberingSession(drive, LandmarkField(drive.world) if day else field)
    (whole_tile,), vocabulary = estimator_loop.survey_map(survey, np.random.default_rng(seed), every_m=_EVERY_M)
    tile = within_budget(whole_tile, survey.camera, survey.body_from_cam)
    view = MapView([tile], vocabulary, robot.camera.focal_px)
    return Site(robot, tile, view, None if survey_run == "survey-both-ways" else measured_lookalikes(view, survey))


def measured_lookalikes(view: MapView, survey: EstimatorSession) -> LookAlikes | None:
    """The look-alikes of a map, by frames of its survey, as `mapserver build` measures it."""
    numbers = np.linspace(0, len(survey) - 1, PROBES).round().astype(int).tolist()
    places = [survey.map_from_body[number] @ survey.body_from_cam for number in numbers]
    probes = [Probe(survey.camera, estimator_loop.seen(survey, n), at) for n, at in zip(numbers, places, strict=True)]
    starts = starts_without_prior([fixes_of(view, probe) for probe in probes])
    if starts is None:
        return None
    return LookAlikes(starts.lookalike_recall, starts.max_wrong_share, float(starts.lookalike_inliers or 0))


class Start(NamedTuple):
    """How one start went.

    wrong_frames: TRACKING and more than WRONG_M off. ambiguous_frames, and of those with the right place among the hypotheses.
    tracking_s: until the first TRACKING at the right place, None without. late_m: the way by then since the robot left the racks,
    negative before; None where it never tracked rightly. frames: all of the start's.
    """

    frame: int
    wrong_frames: int
    ambiguous_frames: int
    ambiguous_right_frames: int
    tracking_s: float | None
    late_m: float | None
    frames: int


def prior_at(session: EstimatorSession, sigma_m: float, rng: np.random.Generator) -> PositionPrior:
    """The place at the session's first frame, known so well."""
    map_from_base = session.map_from_body[0] @ se3_inverse(session.session.nominal.base_from_body)
    map_from_base[:2, 3] += rng.normal(0.0, sigma_m, 2)
    return PositionPrior(
        session.stamps_ns[0], map_from_base, np.diag([np.inf, np.inf, np.inf, sigma_m**2, sigma_m**2, np.inf])
    )


def ways_m(session: EstimatorSession) -> Array:
    """(N,) way driven up to each frame since the one at which the racks end; the whole way where they never do."""
    layout = session.session.world.layout
    positions = session.map_from_body[:, :2, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    is_outside = (positions[:, 0] < layout.end_m) | (positions[:, 0] > layout.bay_x_m(layout.bays))
    return way - way[int(np.argmax(is_outside))] if is_outside.any() else way - way[-1]


def judged(frame: int, session: EstimatorSession, estimates: list[Estimate]) -> Start:
    """The start's outcome."""
    wrong = ambiguous = with_right = 0
    first: int | None = None
    for number, (estimate, truth) in enumerate(zip(estimates, session.map_from_body, strict=False)):
        if estimate.status is Status.TRACKING:
            off = bool(np.linalg.norm(estimate.map_from_body[:3, 3] - truth[:3, 3]) > WRONG_M)
            wrong += off
            first = number if first is None and not off else first
        elif estimate.status is Status.AMBIGUOUS:
            ambiguous += 1
            off_m = [np.linalg.norm(h.map_from_body[:3, 3] - truth[:3, 3]) for h in estimate.hypotheses]
            with_right += bool(min(off_m) < RIGHT_M)
    if first is None:
        return Start(frame, wrong, ambiguous, with_right, None, None, len(estimates))
    took_s = (estimates[first].stamp_ns - session.stamps_ns[0]) * 1e-9
    return Start(frame, wrong, ambiguous, with_right, took_s, float(ways_m(session)[first]), len(estimates))


def start_at(
    site: Site, number: int, duration_s: float, prior_sigma_m: float | None, rng: np.random.Generator,
    settings: LocalizerSettings = estimator_loop.SETTINGS,
) -> Start:  # fmt: skip
    """The outcome of waking at a frame, for so long."""
    session = LateSession(site.robot, number)
    prior = None if prior_sigma_m is None else prior_at(session, prior_sigma_m, rng)
    count = int(np.searchsorted(session.stamps_ns, session.stamps_ns[0] + int(duration_s * 1e9)))
    known = estimator_loop.run_localizer(
        session, site.view, prior, count, settings=settings, lookalikes=site.lookalikes
    )
    return judged(number, session, known)


def standing_start_at(site: Site, number: int, duration_s: float) -> Start:
    """The outcome of standing where a frame was taken, for so long, without a prior."""
    drive = site.robot.session
    stands = standing(drive, drive.frame_times_s[number], number, duration_s)
    stands.renderer.close()
    session = LateSession(EstimatorSession(stands, field=site.robot.field), 0)
    known = estimator_loop.run_localizer(session, site.view, lookalikes=site.lookalikes)
    return judged(number, session, known)


def resolving_start_at(site: Site, number: int, beyond_m: float, settings: LocalizerSettings) -> Start:
    """The outcome of waking at a frame among the racks without a prior, until the place is known or the robot is so far out of them."""
    session = LateSession(site.robot, number)
    count = int(np.searchsorted(ways_m(session), beyond_m))
    known = estimator_loop.run_localizer(
        session, site.view, None, count, settings=settings, until=lambda estimate: estimate.status is Status.TRACKING
    )
    return judged(number, session, known)


def drive_from(site: Site, number: int, way_m: float, settings: LocalizerSettings) -> Start:
    """The outcome of waking at a frame without a prior and driving so far."""
    session = LateSession(site.robot, number)
    count = int(np.searchsorted(ways_m(session) - ways_m(session)[0], way_m))
    return judged(number, session, estimator_loop.run_localizer(session, site.view, None, count, settings=settings))


def among_racks(session: EstimatorSession) -> NDArray[np.int64]:
    """Frames between the racks of the drive's first aisle, the last two metres left out."""
    layout, positions = session.session.world.layout, session.map_from_body[:, :2, 3]
    inside = (positions[:, 0] > layout.end_m) & (positions[:, 0] < layout.bay_x_m(layout.bays) - 2.0)
    first = int(np.argmax(inside))
    return np.arange(first, first + int(np.argmin(inside[first:])))


def part_of(tile: Tile, kept: NDArray[np.bool_], places: NDArray[np.bool_]) -> Tile:
    """Those landmarks and places alone."""
    dropped = tile.landmark_ids[~kept]
    lists = [ids for ids, held in zip(tile.place_landmark_ids, places, strict=True) if held]
    return replace(
        tile, landmark_ids=tile.landmark_ids[kept], points_map=tile.points_map[kept], descriptors=tile.descriptors[kept],
        view_directions_map=tile.view_directions_map[kept], view_half_angle_rad=tile.view_half_angle_rad[kept],
        max_distance_m=tile.max_distance_m[kept], sigma_m=tile.sigma_m[kept], place_ids=tile.place_ids[places],
        map_from_cam=tile.map_from_cam[places],
        place_landmark_ids=tuple(ids[~np.isin(ids, dropped)] for ids in lists),
    )  # fmt: skip


def within_budget(tile: Tile, camera: StereoCamera, body_from_cam: Array) -> Tile:
    """The landmarks that `mapserver` would publish of a survey that is the tile's places."""
    cam_from_map = se3_inverse(tile.map_from_cam)
    counts = [len(ids) for ids in tile.place_landmark_ids]
    keyframe = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    landmark = np.searchsorted(tile.landmark_ids, np.concatenate(tile.place_landmark_ids)).astype(np.int32)
    points_cam = np.einsum("mij,mj->mi", cam_from_map[keyframe, :3, :3], tile.points_map[landmark])
    pixels = camera.pixel_from_point(points_cam + cam_from_map[keyframe, :3, 3])
    ahead = np.isfinite(pixels[:, 0])  # the map's error may put what was close behind the camera
    keyframe, landmark, pixels = keyframe[ahead], landmark[ahead], pixels[ahead]
    stamps_ns = np.arange(len(counts), dtype=np.int64)
    map_from_body = tile.map_from_cam @ se3_inverse(body_from_cam)
    survey = SurveyMap(
        camera, body_from_cam, stamps_ns, map_from_body, tile.landmark_ids, tile.points_map, tile.descriptors,
        tile.sigma_m.astype(np.float64), keyframe, landmark, pixels,
        np.zeros(len(keyframe), np.int8), np.ones((len(keyframe), 2)), Trajectory(stamps_ns, map_from_body), np.ones(len(counts), bool),
        np.zeros((len(tile.landmark_ids), 1, 1), np.uint8),
    )  # fmt: skip
    return part_of(tile, choose_landmarks(survey, BudgetSettings()), np.ones(len(counts), bool))


def with_aisles(site: Site, aisles: tuple[int, ...]) -> Site:
    """The site with a map of those aisles alone."""
    layout = site.robot.session.world.layout
    centres = np.array([layout.aisle_y_m(aisle) for aisle in aisles])

    def near(ys_m: Array) -> NDArray[np.bool_]:
        return np.asarray((np.abs(ys_m[:, None] - centres) < layout.pitch_m / 2).any(axis=1))

    part = part_of(site.tile, near(site.tile.points_map[:, 1]), near(site.tile.map_from_cam[:, 1, 3]))
    return Site(site.robot, part, MapView([part], site.view.vocabulary, site.robot.camera.focal_px))


def summary(found: Iterable[Start], within_s: float) -> dict[str, float]:
    """Shares over the starts."""
    starts = list(found)
    ambiguous = sum(s.ambiguous_frames for s in starts)
    soon = [s.tracking_s is not None and s.tracking_s <= within_s for s in starts]
    return {
        "starts": len(starts),
        "wrong_starts": sum(s.wrong_frames > 0 for s in starts),
        "right_in_time_share": float(np.mean(soon)),
        "tracking_share": float(np.mean([s.tracking_s is not None for s in starts])),
        "ambiguous_starts_share": float(np.mean([s.ambiguous_frames > 0 for s in starts])),
        "right_among_hypotheses_share": sum(s.ambiguous_right_frames for s in starts) / ambiguous if ambiguous else 1.0,
    }
