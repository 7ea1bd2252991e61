"""Surveys without pictures: what `support.estimator` measures goes through the odometry and the back end that surveys have.

Features, their disparities and the points that flow follows come from a session. Sub-pixel alignment needs pictures, so that the
coordinates which it finds are drawn instead: exact ones with noise where feature and reference show one landmark, those of the
detector where they do not. All else is the survey's own code.
"""

import pickle
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.estimator_loop import EstimatorTracker, blank
from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.features import orb, patch_align
from fleetmap.geometry import Array
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import wheel_between
from fleetsim.motion import Route
from fleetsim.recorder import Order
from fleetsim.scenarios import SCENARIOS
from mapserver.survey.executor import Executor
from mapserver.survey.keyframes.keyframes import set_aside
from mapserver.survey.odometry_pass import OdometryRun, SampleFeed
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import Survey, adjust_chain, finish_survey
from mapserver.survey.state import FrameTracks, ImageStore, Keyframe, OdometryPass, Pictures, RigImages
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs, SurveyTools
from mapserver.survey.tracks import tracks
from support.estimator.simulated_run import EstimatorSession, unpictured

_ALIGNED_PX, _DISPARITY_PX = (
    0.2,
    0.13,
)  # errors of aligned coordinates and of disparities, as rendered pictures show them
_SIZE_PX = (480, 640)
_TURNING_M = 4.0
_EVER_NS = -(2**62)


class GreyPictures(ImageStore):
    """A store in which every keyframe has the same picture: patches are cut of it, nothing is measured in it."""

    def __init__(self) -> None:
        left = np.random.default_rng(1).integers(0, 255, _SIZE_PX, np.uint8)
        self._pictures = Pictures(RectifiedFrame(0, left, left, None), patch_align.half_pyramid(left))

    def put(self, pictures: Pictures) -> int:
        """Keeps nothing."""
        return 0

    def get(self, number: int) -> Pictures:
        """The one there is."""
        return self._pictures


@dataclass(frozen=True)
class SimulatedSurvey:
    """The odometry of a session, and for each view of its keyframes, K in all, which landmark a feature shows and where that is, exactly.

    landmarks: K arrays (N,), 0 for clutter; exact_px: K arrays (N, 3) u_left v u_right; map_from_body (F, 4, 4) the truth of all frames.
    """

    odometry: OdometryPass
    inputs: SurveyInputs
    landmarks: list[NDArray[np.uint64]]
    exact_px: list[NDArray[np.float32]]
    map_from_body: Array

    def surveyed(self, settings: SurveySettings, tools: SurveyTools | None = None) -> Survey:
        """All stages after the odometry."""
        tools, config = tools or SurveyTools(), SurveyConfig(settings, default_vocabulary())
        return finish_survey(adjust_chain(self.odometry, self.inputs, settings, tools), self.inputs, config, tools)

    def write(self, path: Path) -> None:
        """Writes it so that `read` need not hold more of it in memory than is asked for."""
        odometry = replace(self.odometry, keyframes=[])
        with path.open("wb") as file:
            pickle.dump((odometry, self.inputs, self.map_from_body, len(self.landmarks)), file, protocol=5)
            for keyframe, landmarks, exact_px in zip(
                self.odometry.keyframes, self.landmarks, self.exact_px, strict=True
            ):
                bare = replace(keyframe, images=None)  # type: ignore[arg-type]  the one picture is made anew
                pickle.dump((bare, landmarks, exact_px), file, protocol=5)

    @classmethod
    def read(cls, path: Path, keyframes: int, store: ImageStore) -> "SimulatedSurvey":
        """The survey up to its keyframe number `keyframes`; `store` keeps what the keyframes show."""
        images, kept = GreyPictures(), list[Keyframe]()
        landmarks, exact_px = list[NDArray[np.uint64]](), list[NDArray[np.float32]]()
        with path.open("rb") as file:
            own, inputs, map_from_body, count = pickle.load(file)
            frames = len(own.estimates)
            for number in range(min(keyframes + 1, count)):
                bare, ids, exact = pickle.load(file)
                if number == keyframes:
                    frames = bare.frame_index
                    break
                kept.append(set_aside(replace(bare, images=images), store))
                ids, exact = store.keep((ids, exact))
                landmarks.append(ids)
                exact_px.append(exact)
        store.release()
        ends = own.tracks.starts[: frames + 1]
        odometry = replace(
            own, estimates=own.estimates[:frames], odom_from_body=own.odom_from_body[:frames],
            covariances=own.covariances[:frames], tracked=own.tracked[:frames], keyframes=kept,
            tracks=FrameTracks(ends, own.tracks.ids[: ends[-1]].copy(), own.tracks.pixels[: ends[-1]].copy()),
        )  # fmt: skip
        until_ns = own.estimates[frames - 1].stamp_ns + 1_000_000_000
        imu, wheel = inputs.imu.between(_EVER_NS, until_ns), wheel_between(inputs.wheel, _EVER_NS, until_ns)
        inputs = replace(inputs, frame_count=frames, imu=imu, wheel=wheel)
        return cls(odometry, inputs, landmarks, exact_px, map_from_body[:frames])


def session_of(
    scenario: str, robots: Sequence[str], seed: int = 0, rate_hz: float = 7.5, frames: int | None = None
) -> EstimatorSession:
    """A scenario's runs, driven one after the other without a break, at another frame rate."""
    base, name = SCENARIOS[scenario](), "+".join(robots)
    runs = [base.runs[robot] for robot in robots]
    joined = replace(runs[0], rate_hz=rate_hz, routes=(_one_after_the_other([run.routes[0] for run in runs]),))
    order = Order(scenario, seed=seed, robot=name, frames=frames)
    return EstimatorSession(unpictured(order, replace(base, runs={name: joined})))


def _one_after_the_other(routes: Sequence[Route]) -> Route:
    """One route of several that begin and end at the racks' side towards the docks, where there is room to turn."""
    points = list(routes[0].way_points_map)
    for route in routes[1:]:
        aside_m = min(points[-1][0], route.way_points_map[0][0]) - _TURNING_M
        points += [(aside_m, points[-1][1]), (aside_m, route.way_points_map[0][1]), *route.way_points_map]
    return replace(routes[0], way_points_map=tuple(points))


def simulated_survey(
    session: EstimatorSession, settings: SurveySettings, others: Sequence[EstimatorSession] = ()
) -> SimulatedSurvey:
    """The odometry over a session, with the keyframes that its policy chooses. others: the rig's other views."""
    nominal = session.session.nominal
    if not others:
        nominal = replace(nominal, cameras=tuple(nominal.cameras[number] for number in nominal.views[0]))
    rectifier = Rectifier(nominal)
    run = OdometryRun(nominal, rectifier, settings)
    run._odometry._tracker = EstimatorTracker(session, session.camera, settings.odometry.tracker)  # type: ignore[attr-defined]
    feed = SampleFeed(session.session.imu, session.session.wheel, rectifier.imu_minus_cam_s)
    images, seen = GreyPictures(), list[FrameTracks]()
    keyframes, landmarks, exact_px = list[Keyframe](), list[NDArray[np.uint64]](), list[NDArray[np.float32]]()
    for number in range(len(session)):
        frame = blank(session, number)
        tracked = run.handle(frame, *feed.until(frame.stamp_ns))
        seen.append(FrameTracks.of_frame(tracked.estimate))
        if tracked.is_keyframe:
            baseline_m = session.camera.baseline_m
            views = [_keyframe(each, number, images, baseline_m) for each in (session, *others)]
            (first, *further), ids, exact = zip(*views, strict=True)
            keyframes.append(replace(first, others=tuple(further)))
            landmarks.extend(ids)
            exact_px.extend(exact)
    estimates = run.chain.estimates
    odometry = OdometryPass(
        estimates, run.chain.odom_from_body(), run.chain.covariances(),
        np.array([e.status is not OdometryStatus.DEGRADED for e in estimates]), keyframes, estimates[-1].inertial,
        estimates[-1].scale_known, estimates[-1].inertial and settings.odometry.filter.use_wheels, FrameTracks.joined(seen),
    )  # fmt: skip
    inputs = SurveyInputs([], len(session), session.session.imu, nominal, rectifier, session.session.wheel)
    return SimulatedSurvey(odometry, inputs, landmarks, exact_px, session.map_from_body)


def _keyframe(
    session: EstimatorSession, number: int, images: GreyPictures, baseline_m: float
) -> tuple[Keyframe, NDArray[np.uint64], NDArray[np.float32]]:
    """A keyframe with disparities over baseline_m, the landmarks (N,) that its features show, and where these are exactly (N, 3)."""
    found, sighting = session.features(number), session.sighting(number)
    real = found.rows >= 0
    ids, exact = np.zeros(len(real), np.uint64), np.zeros((len(real), 3), np.float32)
    ids[real], exact[real] = sighting.ids[found.rows[real]], sighting.pixels[found.rows[real]]
    measured = found.pixels[:, 0] - found.pixels[:, 2]
    points = session.camera.point_from_pixel(found.pixels[:, :2], measured)
    scale = baseline_m / session.camera.baseline_m if session.camera.baseline_m else 1.0
    if scale != 1.0:
        exact[:, 2] = exact[:, 0] - np.float32(scale) * (exact[:, 0] - exact[:, 2])
    sigmas = np.where(np.isfinite(measured), scale * _DISPARITY_PX, np.nan)
    disparities = np.column_stack([measured * scale, sigmas])
    angles = np.zeros(len(real), np.float32)
    features = orb.Features(found.pixels[:, :2].copy(), found.octaves.copy(), angles, found.descriptors.copy())
    return Keyframe(number, session.stamps_ns[number], features, disparities, points, images, 0), ids, exact


@contextmanager
def drawn_alignment(survey: SimulatedSurvey) -> Iterator[None]:
    """Alignment's results are drawn while this holds; equal arguments give equal results."""
    every = (image for keyframe in survey.odometry.keyframes for image in (keyframe, *keyframe.others))
    number = {id(image.features): n for n, image in enumerate(every)}

    def observe(
        posed: RigImages, table: NDArray[np.int64], points_map: Array, settings: SurveySettings, executor: Executor
    ) -> tuple[Array, Array]:
        """As `tracks._observe`."""
        noise = settings.noise
        is_reference = np.diff(table[:, 1], prepend=-1) != 0
        reference_row = np.maximum.accumulate(np.where(is_reference, np.arange(len(table)), 0))
        shown, octaves = np.zeros(len(table), np.uint64), np.zeros(len(table), np.int8)
        pixels, own = np.empty((len(table), 3)), np.empty((len(table), 3))
        order = np.argsort(table[:, 0], kind="stable")
        ends = np.cumsum(np.bincount(table[:, 0], minlength=len(posed.images)))
        for keyframe, rows in zip(posed.images, np.split(order, ends[:-1]), strict=True):
            k, features = number[id(keyframe.features)], table[rows, 2]
            shown[rows], octaves[rows] = survey.landmarks[k][features], keyframe.features.octaves[features]
            drawn = np.random.default_rng([7, k]).standard_normal((len(keyframe.features), 3), np.float32)[features]
            pixels[rows] = survey.exact_px[k][features] + drawn * np.float32(_ALIGNED_PX)
            measured = keyframe.measured(features)
            noise_px = drawn[:, 2] * np.nan_to_num(measured[:, 1].astype(np.float32))
            disparity = survey.exact_px[k][features, 0] - survey.exact_px[k][features, 2] + noise_px
            pixels[rows, 2] = pixels[rows, 0] - disparity
            own[rows, :2] = keyframe.features.pixels[features]
            own[rows, 2] = own[rows, 0] - measured[:, 0]
        sure = (shown == shown[reference_row]) & (shown > 0)
        sigmas = np.where(sure, noise.aligned_sigma_px, noise.descriptor_sigma_px * 1.2 ** octaves.astype(np.float64))
        measured = np.where(np.isfinite(own[:, 2]), noise.disparity_sigma_px, np.hypot(noise.disparity_sigma_px, 1.0))
        pixels[np.isnan(own[:, 2]), 2] = np.nan
        return np.where(sure[:, None], pixels, own), np.column_stack([sigmas, measured])

    with patch.object(tracks, "_observe", observe):
        yield
