"""Robots that fail for a known reason, at the estimator's level: the robot's own loop from samples to its failure report."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.common import estimator_loop
from benchmarks.robot.aliased_starts import part_of, prior_at, within_budget
from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.features.orb import Features
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.mapformat.tile import Tile
from fleetmap.messages import FailureReport
from fleetmap.relocalization.map_view import MapView
from fleetmap.sensors.rectification import MountedCamera, MountedRig
from fleetmap.sensors.samples import Image, ImuSamples, PositionPrior, wheel_between
from fleetmap.sources.sensor_bundle import SensorBundle
from fleetsim.motion import Limits, Route
from fleetsim.recorder import Order, Session
from fleetsim.scenarios import Run, Scenario
from fleetsim.scene.layout import Layout
from fleetsim.scene.world import World
from fleetsim.sensors import ROBOTS, Fault
from fleetsim.textures.texture_set import paint_textures
from locclient.localization.held_maps import HeldMap
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings
from locclient.maps.loaded_map import LoadedMap
from locclient.robot import failure_report
from locclient.robot.robot import FailureContext, Robot
from locclient.robot.version_trial import TrialSettings
from support.estimator.hashing import mixed, uniform
from support.estimator.landmarks import LandmarkField, Landmarks
from support.estimator.simulated_run import EstimatorSession, Smudge, unpictured

LAYOUTS = Layout(aisles=4, bays=8), Layout(aisles=4, bays=8, are_aisles_identical=True)
LAYOUT = LAYOUTS[0]
_LEFT_M, _RIGHT_M, _TILE_M, _RATE_HZ = 2.7, LAYOUTS[0].length_m - 2.7, 10.0, 5.0
Random = np.random.Generator
SETTINGS = LocalizerSettings()
_LONGEST_S, _FLOOR_M = 34.0, 0.05  # of a drive; lower landmarks are the ground's
_painted = lru_cache(maxsize=4)(paint_textures)


@dataclass(frozen=True)
class _Held(LoadedMap):
    """A map whose eyes are a session's."""

    view: Any = None
    session: Any = None

    def show(self, localizer: Localizer, site: str = "") -> None:
        relocalizer = estimator_loop.SessionRelocalizer(self.view, self.session, SETTINGS)
        localizer.maps.by_floor[site] = HeldMap(1, (relocalizer,))


class ChangedField(LandmarkField):
    """In some aisles a share of the landmarks is others than on the day of the survey, and what stands on the floor is moved along x."""

    def __init__(self, base: LandmarkField, share: float, moved_m: float, aisles: Sequence[int]) -> None:
        super().__init__(base._world, remembered=150)
        self._base, self._share, self._moved_m, self._aisles = base, share, moved_m, aisles

    def chunk(self, column: int, row: int) -> Landmarks:
        found, self._bounds = self._base.chunk(column, row), self._base._bounds
        if row not in self._aisles:
            return found
        keys, points = found.keys.copy(), found.points_map.copy()
        new = uniform(mixed(keys[:, 2], 77)) < self._share
        keys[new, 0], keys[new, 2] = mixed(keys[new, 0], 1), mixed(keys[new, 2], 1) >> np.uint64(2)
        points[points[:, 2] > _FLOOR_M, 0] += self._moved_m
        return replace(found, keys=keys, points_map=points)


def way(rng: Random, length_m: float, first: int, others: Sequence[int]) -> Route:
    """From the middle of an aisle to its end, into another one of `others`, and so on."""
    at_right = bool(rng.integers(2))
    points = [(float(rng.uniform(_LEFT_M + 8.0, _RIGHT_M - 8.0)), LAYOUT.aisle_y_m(first))]
    while length_m > 0.0:
        end_m = _RIGHT_M if at_right else _LEFT_M
        first = int(rng.choice([other for other in others if other != first] or others))
        points += [(end_m, points[-1][1])]
        points += [(end_m, LAYOUT.aisle_y_m(first))] if LAYOUT.aisle_y_m(first) != points[-1][1] else []
        length_m -= abs(end_m - points[-3][0]) + 4.0
        at_right = not at_right
    return Route((*points, (points[-1][0] + (8.0 if at_right else -8.0), points[-1][1])))


@lru_cache(maxsize=4)
def surveyed(seed: int) -> tuple[Tile, Vocabulary, float]:
    """The map of a survey of every aisle both ways, on day 0."""
    points: list[tuple[float, float]] = []
    for out, back in ((0, 1), (2, 3), (1, 0), (3, 2)):
        y_m, back_m = LAYOUT.aisle_y_m(out), LAYOUT.aisle_y_m(back)
        points += [] if points and points[-1] == (_LEFT_M, y_m) else [(_LEFT_M, y_m)]
        points += [(_RIGHT_M, y_m), (_RIGHT_M, back_m), (_LEFT_M, back_m)]
    run = Run("surveyor", (Route(tuple(points)),), 5.0, is_sharp=True)
    survey = EstimatorSession(_prepared(seed, 0, "survey", run), field=_usual(seed, 0))
    (tile,), vocabulary = estimator_loop.survey_map(survey, np.random.default_rng(seed), every_m=0.8)
    return within_budget(tile, survey.camera, survey.body_from_cam), vocabulary, survey.camera.focal_px


def _prepared(seed: int, day: int, name: str, run: Run) -> Session:
    """Every second seed has aisles that are all alike."""
    creeper = {"creeper": replace(ROBOTS["runner"], limits=Limits(0.8, 0.5, 0.8, 0.7))}
    with patch("fleetsim.scene.world.paint_textures", _painted), patch.dict(ROBOTS, creeper):
        return unpictured(Order("failed", seed, day), Scenario("", LAYOUTS[seed % 2], {name: run}))


@lru_cache(maxsize=4)
def _usual(seed: int, day: int) -> LandmarkField:
    with patch("fleetsim.scene.world.paint_textures", _painted):
        return LandmarkField(World(LAYOUTS[seed % 2], seed=seed, day=day), remembered=300)


@lru_cache(maxsize=10)
def _changed(seed: int, share: float, moved_m: float, aisles: tuple[int, ...]) -> LandmarkField:
    return ChangedField(_usual(seed, 1), share, moved_m, aisles)


@dataclass(frozen=True)
class Case:
    """What is wrong on a drive.

    share: of the landmarks of the `changed` aisles, which are others; moved_m: of their racks along x. is_told: its place, as by a dock,
    which is wrong_m off; mapped: aisles in the map; dropped: share of the frames, negative: when the IMU is pushed; turn: of the right one.
    """

    truth: str
    faults: tuple[Fault, ...] = ()
    before: tuple[Route, ...] = ()
    share: float = 0.0
    moved_m: float = 0.0
    changed: tuple[int, ...] = ()
    smudge: Smudge | None = None
    is_told: bool = True
    wrong_m: float = 0.0
    robot: str = "runner"
    has_imu: bool = True
    has_wheels: bool = True
    dropped: float = 0.0
    mapped: tuple[int, ...] = (0, 1, 2, 3)
    turn: Array | None = None


def case_of(name: str, rng: Random, shared: Random, first: int, others: tuple[int, ...]) -> Case:
    """What is wrong in a cause's drive from aisle `first` to `others`."""
    begins, aids = float(rng.uniform(5.0, 9.0)), {"has_imu": bool(rng.integers(2)), "has_wheels": bool(rng.integers(2))}
    if name == "dark camera":
        return Case("robot", (Fault(str(rng.choice(["camera-dark", "over-exposure"])), begins, begins + 60.0),), **aids)
    if name == "dirty camera":
        centre = rng.uniform((250, 180), (390, 300)).tolist()
        return Case("robot", smudge=Smudge(*centre, float(rng.uniform(300.0, 400.0))), **aids)
    if name == "overload":
        return Case("robot", dropped=float(rng.uniform(0.6, 0.9)), **aids)
    if name == "carried":
        return Case("robot", before=(way(rng, 4.0, first, others),), **aids)
    if name == "wrong calibration":
        return Case("robot", turn=so3_exp(rng.choice([-1.0, 1.0], 3) * np.radians(rng.uniform(0.3, 3.0, 3))), **aids)
    if name == "pushed IMU":
        return Case("robot", has_wheels=False, dropped=-begins)
    if name == "lost IMU":  # by which a robot without wheels does not survive a darkness that it usually does
        dark_s = begins + 1.5, begins + 1.5 + float(rng.uniform(1.0, 3.0))
        return Case("robot", (Fault("imu-gap", begins, begins + 60.0), Fault("camera-dark", *dark_s)), has_wheels=False)
    changed = (*others, first) if rng.random() < 0.5 else others
    if name == "restocked":
        return Case("building", share=float(rng.choice([0.96, 1.0])), changed=changed, **aids)
    if name == "racks moved":
        moved_m = float(shared.choice([-1.0, 1.0]) * shared.uniform(0.5, 2.2))
        return Case("building", moved_m=moved_m, changed=others, **aids)
    if name == "identical aisle":
        wrong_m, is_told = float(rng.choice([-1.0, 1.0])) * LAYOUT.pitch_m, bool(rng.integers(2))
        return Case("lookalike", is_told=is_told, wrong_m=wrong_m, robot="runner" if is_told else "creeper", **aids)
    return Case("lookalike", is_told=bool(rng.integers(2)), mapped=(first, others[2]), **aids)


LOOKALIKES = "identical aisle", "unmapped look-alike"
OWN = "dark camera", "dirty camera", "overload", "carried", "wrong calibration", "pushed IMU"
TRUTHS = dict.fromkeys(OWN, "robot") | dict.fromkeys(("restocked", "racks moved"), "building")
TRUTHS |= dict.fromkeys(LOOKALIKES, "lookalike") | {"lost IMU": "robot"}
CAUSES = tuple(TRUTHS)


@lru_cache(maxsize=6)
def _view(seed: int, mapped: tuple[int, ...]) -> tuple[MapView, Tile]:
    tile, vocabulary, focal_px = surveyed(seed)
    centres = np.array([LAYOUT.aisle_y_m(aisle) for aisle in mapped])
    if len(mapped) < LAYOUT.aisles:
        ys_m = tile.points_map[:, 1], tile.map_from_cam[:, 1, 3]
        tile = part_of(tile, *((np.abs(y_m[:, None] - centres) < LAYOUT.pitch_m / 2).any(axis=1) for y_m in ys_m))
    return MapView([tile], vocabulary, focal_px), tile


def fail(name: str, seed: int, number: int) -> FailureReport | None:
    """The report of one robot; None if it does not fail."""
    rng, own = np.random.default_rng([seed, number]), np.random.default_rng([seed, 1 + CAUSES.index(name), number])
    first, *others = np.random.default_rng([seed, number // 8]).permutation(LAYOUT.aisles).tolist()
    case = case_of(name, own, np.random.default_rng([seed, number // 8, 9]), first, tuple(others))
    begin, driven = (first, others) if len(case.mapped) == 4 else (first if case.is_told else others[0], others[:2])
    route, day = way(rng, 60.0, begin, driven), int(case.truth != "lookalike")
    drive = Run(case.robot, (*case.before, route), _RATE_HZ, faults=case.faults)
    session = _prepared(seed, day, f"way-{number}", drive)
    if not case.has_imu:
        session = replace(session, imu=ImuSamples.empty(), nominal=replace(session.nominal, imu=None))
    if case.dropped < 0:
        imu = session.imu
        times_s = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
        push = own.uniform(1.0, 3.0) / 0.2 * so3_exp(np.array([0, 0, own.uniform(0, 6.28)]))[:, 0]
        accel = imu.accel_mps2 + ((times_s > -case.dropped) & (times_s < -case.dropped + 0.2))[:, None] * push
        session = replace(session, imu=ImuSamples(imu.stamps_ns, imu.gyro_radps, accel))
    if case.turn is not None:
        left, right = session.true.cameras
        right = replace(right, body_from_cam=right.body_from_cam @ se3(case.turn, np.zeros(3)))
        session = replace(session, true=replace(session.true, cameras=(left, right)))
    field = _changed(seed, case.share, case.moved_m, case.changed) if case.changed else _usual(seed, day)
    run = EstimatorSession(session, field=field, smudge=case.smudge)
    return _driven(run, case, own, *_view(seed, case.mapped))


def _driven(run: EstimatorSession, case: Case, rng: Random, view: MapView, tile: Tile) -> FailureReport | None:
    nominal, mounted = run.session.nominal, (MountedCamera(run.camera, run.body_from_cam),)
    rig = MountedRig(nominal, mounted, nominal.cameras[0].imu_minus_cam_s)
    mounting = {"rig": rig, "calibration": nominal, "mounted": mounted, "body_from_cam": run.body_from_cam}
    mounting |= {"imu_minus_cam_s": rig.imu_minus_cam_s, "rectify": lambda frame: frame}
    robot = Robot(SimpleNamespace(**mounting), SETTINGS, TrialSettings())
    odometry, settings = robot.localizer.perception.odometry, SETTINGS.odometry.tracker
    odometry._new_tracker = lambda first, _: estimator_loop.EstimatorTracker(run, run.camera, settings, first)
    odometry._tracker = odometry._new_tracker(0, 0)
    cells = [SimpleNamespace(x=x, y=y) for x in range(4) for y in range(3)]
    manifest = SimpleNamespace(tile_size_m=_TILE_M, tiles=cells, version=1, report={}, building=None)
    robot.versions._show = lambda loaded: loaded.show(robot.localizer)
    version = SimpleNamespace(version=1, manifest_sha256="", site="hall")
    robot.use(_Held(version, manifest, None, {(0, 0): tile}, view=view, session=run))
    last_ns, dropped, arrives = 0, 0, rng.random(len(run)) >= case.dropped
    for frame, stamp_ns in enumerate(run.stamps_ns[: int(_LONGEST_S * _RATE_HZ)]):
        if frame > 30 and not arrives[frame]:
            dropped += 1
            odometry._tracker._frame_index += 1
            continue
        imu = run.session.imu.between(last_ns, stamp_ns + 1)
        wheel = wheel_between(run.session.wheel, last_ns, stamp_ns + 1) if case.has_wheels else []
        prior = [_told(run, rng, case.wrong_m)] if case.is_told and frame == 0 else []
        last_ns, image = stamp_ns + 1, estimator_loop.blank(run, frame)
        left = image.left.copy()
        left[1, 1:5] = np.frombuffer(frame.to_bytes(4, "little"), np.uint8)
        outcome = robot.handle(SensorBundle(replace(image, left=left), imu, wheel, prior, dropped=dropped))
        dropped = 0
        if outcome is not None and outcome.failure is not None:
            return _report(run, outcome.failure, rig)
    return None


def _told(run: EstimatorSession, rng: Random, wrong_m: float) -> PositionPrior:
    """A dock's report, which knows the heading to two degrees; wrong_m: that of another aisle's dock."""
    prior = prior_at(run, 0.05, rng)
    prior.map_from_base[1, 3] += wrong_m
    return replace(prior, cov_rot_trans=np.diag([1e-3, 1e-3, 1e-3, 0.05**2, 0.05**2, 0.05**2]))


def _report(run: EstimatorSession, failure: FailureContext, rig: MountedRig) -> FailureReport:
    def extract(left: Image, *_: object) -> Features:
        return estimator_loop.seen(run, int.from_bytes(left[1, 1:5].tobytes(), "little")).features

    with patch.object(failure_report, "extract", extract):
        profile = failure_report.RobotProfile("hall", "r1", rig, SETTINGS, "off")
        return failure_report.failure_report(failure, profile, report_id="f", wall_ns=0)
