"""A robot with several views: it is localised by whichever sees the map, and goes on when one of them is covered."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from unittest.mock import patch

import numpy as np
import pytest

from benchmarks.common import estimator_loop
from fleetmap.geometry import se3_inverse
from fleetmap.messages import Cause, Status
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.odometry.modes import InertialMode
from fleetmap.relocalization.map_view import MapView
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, SensorSet
from fleetsim.motion import Route
from fleetsim.recorder import Order, prepare
from fleetsim.scenarios import SCENARIOS, Run, Scenario
from fleetsim.scene.layout import Layout
from locclient.localization.estimate import Estimate
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession
from support.recordings.painted_room import frame_of_both, measured, rig, standing_first
from support.recordings.recording_samples import FRAME_NS, IMU_NS

LAYOUT = Layout(aisles=2, bays=4)
WEST_M, EAST_M, Y_M = 4.5, 8.5, LAYOUT.aisle_y_m(0)
ALWAYS = (0.0, 1e3)


@lru_cache(maxsize=8)
def views(
    kind: str, points: tuple[tuple[float, float], ...], covered_s: tuple[float, float], rig: str = "front-rear"
) -> list[EstimatorSession]:
    """The views of a robot with a pair in front and one, or a depth camera, behind; covered_s: of the pair in front."""
    run = Run(kind, (Route(points, rest_s=0.5),), 8.0, is_sharp=True)
    with patch.dict(SCENARIOS, {"aisle": lambda: Scenario("one aisle", LAYOUT, {kind: run})}):
        session = prepare(Order("aisle", seed=11, rig=rig))
    session.renderer.close()
    field = LandmarkField(session.world)
    return [EstimatorSession(session, field=field, view=k, covered_s=(0.0, 0.0) if k else covered_s) for k in range(2)]


@lru_cache(maxsize=1)
def east_bound_map() -> MapView:
    """What a survey with one pair saw on its way east."""
    survey, _ = views("surveyor", ((WEST_M, Y_M), (EAST_M, Y_M)), (0.0, 0.0))
    tiles, vocabulary = estimator_loop.survey_map(survey, np.random.default_rng(0), every_m=0.6)
    return MapView(tiles, vocabulary, survey.camera.focal_px)


def driven(
    points: tuple[tuple[float, float], ...], covered_s: tuple[float, float], *, has_rear: bool, rig: str = "front-rear"
) -> list[Estimate]:
    front, rear = views("runner", points, covered_s, rig)
    estimates = estimator_loop.run_localizer(front, east_bound_map(), others=[rear] if has_rear else [])
    known = [(e, truth) for e, truth in zip(estimates, front.map_from_body, strict=True) if e.status is Status.TRACKING]
    for estimate, truth in known:
        assert np.linalg.norm(estimate.map_from_body[:3, 3] - truth[:3, 3]) < 0.1
    return estimates


def share(estimates: list[Estimate]) -> float:
    return float(np.mean([estimate.status is Status.TRACKING for estimate in estimates]))


@pytest.mark.parametrize("rig", ["front-rear", "front-depth"])
def test_against_the_surveys_direction_the_rear_view_knows_the_place(rig: str) -> None:
    west_bound = ((EAST_M - 1.0, Y_M), (WEST_M, Y_M))
    assert share(driven(west_bound, (0.0, 0.0), has_rear=False)) < 0.3
    assert share(driven(west_bound, (0.0, 0.0), has_rear=True, rig=rig)) > 0.9


@pytest.mark.parametrize("rig", ["front-rear", "front-depth"])
def test_with_the_front_covered_all_along_the_rear_view_localises_it(rig: str) -> None:
    """Odometry and fixes come from behind, and every estimate says which view is dark."""
    west_bound = ((EAST_M - 1.0, Y_M), (WEST_M, Y_M))
    estimates = driven(west_bound, ALWAYS, has_rear=True, rig=rig)
    assert share(estimates) > 0.9
    assert all(estimate.view_causes == (Cause.DARK, Cause.NONE) for estimate in estimates)
    assert share(driven(west_bound, ALWAYS, has_rear=False)) == 0.0


# ------------------------------------------------------------------------------------------------------------- pictures

RIDE = standing_first()


@lru_cache(maxsize=200)
def seen_at(stamp_ns: int) -> CameraFrame:
    """With a sensor's noise: otherwise every frame at rest counts as frozen."""
    return with_noise(frame_of_both(RIDE, stamp_ns), np.random.default_rng(stamp_ns))


def localized(
    calibration: RigCalibration, until_ns: int, see: Callable[[int], CameraFrame], *, has_wheels: bool = False
) -> tuple[Localizer, list[Estimate]]:
    """A ride with these frames, but those that the odometry awaits no longer."""
    rectifier, said = Rectifier(calibration), list[Estimate]()
    localizer = Localizer(rectifier.rig, LocalizerSettings())
    for stamp_ns in range(0, until_ns, FRAME_NS):
        if calibration.imu is not None:
            localizer.handle_imu(measured(RIDE, stamp_ns - FRAME_NS, stamp_ns + IMU_NS)[0])
        if has_wheels:
            localizer.handle_wheel([measured(RIDE, stamp_ns, stamp_ns + IMU_NS)[1]])
        frame = rectifier.rectify(see(stamp_ns))
        if not localizer.perception.awaits(frame):
            said.append(localizer.handle_stereo(frame))
    return localizer, said


@pytest.mark.parametrize("sensors", [SensorSet.STEREO, SensorSet.STEREO_INERTIAL])
@pytest.mark.parametrize("fault", ["covered", "frozen", "dead"])
def test_odometry_goes_on_with_the_other_pair_and_a_camera_comes_back(sensors: SensorSet, fault: str) -> None:
    """Of the front pair from 2 to 3.2 s and of the rear pair from 3.4 s on: no frame is lost, and the way is as accurate as before."""
    last = None

    def see(stamp_ns: int) -> CameraFrame:
        nonlocal last
        frame, time_s = seen_at(stamp_ns), stamp_ns * 1e-9
        if 2.0 <= time_s < 3.2 or time_s >= 3.4:
            frame = spoilt(frame, fault, is_rear=time_s > 3.3, last=last)
        last = frame
        return frame

    _, said = localized(rig(sensors, has_rear=True), 4_500_000_000, see)
    assert OdometryStatus.DEGRADED not in {e.odometry.status for e in said}
    steps = [e.odometry.previous_from_body for e in said if e.odometry.previous_from_body is not None]
    truth = se3_inverse(RIDE(0.0)) @ RIDE(4.45)
    assert np.linalg.norm((np.linalg.multi_dot(steps) - truth)[:3, 3]) < 0.03
    front, rear = ([e.view_causes[k] is not Cause.NONE for e in said] for k in (0, 1))
    assert np.flatnonzero(front).tolist() == [*range(40, 64)]
    assert np.flatnonzero(rear).tolist() == [*range(68, 90)]


@pytest.mark.parametrize(
    ("sensors", "covered_s"), [("stereo", 0.2), ("stereo-inertial", 0.2), ("stereo-inertial", 1.2)]
)
def test_a_pair_takes_over_from_a_single_camera(sensors: str, covered_s: float) -> None:
    """Before the scale is known, which wheels give, or the IMU once rest has shown gravity; or after, when rear disparities count."""
    pairs = rig(SensorSet(sensors), has_rear=True)

    def see(stamp_ns: int) -> CameraFrame:
        frame = replace(seen_at(stamp_ns), right=None)
        return spoilt(frame, "covered", is_rear=False, last=frame) if stamp_ns * 1e-9 > covered_s else frame

    with patch.object(InertialMode, "process", autospec=True, side_effect=InertialMode.process) as process:
        single = replace(pairs, cameras=(pairs.cameras[0], *pairs.cameras[2:]))
        localizer, said = localized(single, 2_000_000_000, see, has_wheels=True)
    odometry = said[-1].odometry
    assert localizer.perception.view == 1
    assert all(call.args[2].information is not None for call in process.call_args_list[-3:])
    assert odometry.scale_known
    assert odometry.status is OdometryStatus.TRACKING
    assert error_m(said, 1.25, 1.95) < 0.05


@pytest.mark.parametrize("front", ["covered pair", "single camera"])
def test_a_slower_or_dying_rear_pair_is_not_taken_for_the_front(front: str) -> None:
    """In front a pair that is covered all along while the rear pair has half the rate; or one camera, covered until the rear pair dies."""
    calibration, is_single = rig(SensorSet.STEREO_INERTIAL, has_rear=True), front == "single camera"
    calibration = replace(calibration, cameras=calibration.cameras[is_single and 1 :])

    def see(stamp_ns: int) -> CameraFrame:
        frame = seen_at(stamp_ns)
        is_dead = stamp_ns >= 2_000_000_000 and is_single
        if not is_dead and stamp_ns >= 1_000_000_000:
            frame = replace(frame, left=np.zeros_like(frame.left), right=np.zeros_like(frame.left))
        if is_single:
            frame = replace(frame, left=frame.right if frame.left.any() else frame.left, right=None)
        is_between = stamp_ns // FRAME_NS % 2 and not is_single
        return replace(frame, others=(None,)) if is_dead or is_between else frame

    _, said = localized(calibration, 4_500_000_000, see)
    assert error_m(said, 2.2, 3.0) < 0.03
    lost = sum(e.odometry.status is OdometryStatus.DEGRADED for e in said)
    assert is_single or lost <= 2, "with both pairs gone for a frame; one camera measures no depth here"


def error_m(said: list[Estimate], begin_s: float, end_s: float) -> float:
    """Of the motion between two moments."""
    wanted_ns = (said[0].stamp_ns + at_s * 1e9 for at_s in (begin_s, end_s))
    first, last = (min(said, key=lambda e: abs(e.stamp_ns - at_ns)) for at_ns in wanted_ns)
    moved = se3_inverse(first.odometry.odom_from_body) @ last.odometry.odom_from_body
    return float(np.linalg.norm((moved - se3_inverse(RIDE(begin_s)) @ RIDE(end_s))[:3, 3]))


def with_noise(frame: CameraFrame, rng: np.random.Generator) -> CameraFrame:
    def noisy(image: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        return np.clip(image + rng.integers(-1, 2, image.shape, dtype=np.int16), 0, 255).astype(np.uint8)

    assert frame.right is not None
    others = tuple(with_noise(each, rng) for each in frame.others if each is not None)
    return replace(frame, left=noisy(frame.left), right=noisy(frame.right), others=others)


def spoilt(frame: CameraFrame, fault: str, *, is_rear: bool, last: CameraFrame | None) -> CameraFrame:
    """With a covered view, one that repeats the last image, or one without images; a pair in front without them is black."""
    if fault == "dead" and is_rear:
        return replace(frame, others=(None,))
    view, old = (frame.others[0], last.others[0]) if is_rear else (frame, last)
    bad = replace(view, left=np.zeros_like(view.left), right=np.zeros_like(view.left))
    if fault == "frozen":
        bad = replace(view, left=old.left, right=old.right)
    return replace(frame, others=(bad,)) if is_rear else bad
