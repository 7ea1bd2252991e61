"""A map of rendered pictures from true places and depths: what `estimator_loop.survey_map` imitates, without a survey's own errors."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.estimator_loop import Observed, is_new_place, tile_of
from benchmarks.simulator.measure_statistics import View, take_views
from fleetmap.bow import Vocabulary
from fleetmap.features import orb
from fleetmap.features.matching import Projected, match_by_projection
from fleetmap.geometry import Array
from fleetmap.mapformat import Tile
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier, StereoCamera
from fleetsim.recorder import Session
from locclient.localization.estimate import Estimate
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings

_RADIUS_PX, _BITS, _RATIO = 3.0, 70, 0.9
_AGE = 15  # places after which a landmark that was not seen is not looked for any more


@dataclass
class _Growing:
    """Landmarks so far, and the places that saw them."""

    observed: list[Observed] = field(default_factory=list)
    last_seen: list[int] = field(default_factory=list)
    places: list[tuple[Array, list[int]]] = field(default_factory=list)

    def rows(self, features: orb.Features, view: View, camera: StereoCamera) -> NDArray[np.int64]:
        """Landmark of each feature (N,), -1 where it is none yet."""
        result = np.full(len(features), -1, np.int64)
        recent = np.flatnonzero(np.array(self.last_seen, np.int64) >= len(self.places) - _AGE)
        if not len(recent):
            return result
        held = [self.observed[k] for k in recent]
        points = np.array([entry.point_map for entry in held])
        distances = np.linalg.norm(points - view.map_from_cam[:3, 3], axis=1)
        octaves = np.log(np.array([e.reaches_m[-1] for e in held]) / distances) / np.log(orb.SCALE_FACTOR)
        span = np.column_stack([np.floor(octaves) - 1, np.ceil(octaves) + 1]).astype(np.int64)
        radius_px = _RADIUS_PX * orb.SCALE_FACTOR ** np.clip(octaves, 0, 5)
        descriptors = np.array([e.descriptors[-1] for e in held])
        projected = Projected(view.expected(points, camera)[:, :2], radius_px, descriptors, span)
        hit, _ = match_by_projection(projected, features, _BITS, _RATIO)
        result[hit[hit >= 0]] = recent[hit >= 0]
        return result

    def add(self, view: View, camera: StereoCamera) -> None:
        """One more place: its features join landmarks or begin new ones."""
        features = orb.detect(view.frame.left, LocalizerSettings().orb)
        points, rows, members = view.points_map(features.pixels, camera), self.rows(features, view, camera), []
        for n in np.flatnonzero(np.isfinite(points).all(axis=1)).tolist():
            landmark = int(rows[n])
            if landmark < 0:
                landmark = len(self.observed)
                self.observed.append(Observed(points[n]))
                self.last_seen.append(len(self.places))
            away = view.map_from_cam[:3, 3] - points[n]
            distance = float(np.linalg.norm(away))
            reach = distance * orb.SCALE_FACTOR ** float(features.octaves[n])
            self.observed[landmark].add(away / distance, reach, features.descriptors[n])
            self.last_seen[landmark] = len(self.places)
            members.append(landmark)
        self.places.append((view.map_from_cam, members))


def survey_map(session: Session, rng: np.random.Generator, sigma_m: float) -> tuple[list[Tile], Vocabulary]:
    """As `estimator_loop.survey_map`, of pictures: a landmark lies where its first feature shows the true surface."""
    growing, last = _Growing(), None
    for time_s in session.frame_times_s:
        map_from_cam = session.renderer.path(0)(time_s)
        if last is not None and not is_new_place(last, map_from_cam):
            continue
        last = map_from_cam
        camera, views = take_views(session, [time_s])
        growing.add(views[0], camera)
    return tile_of(dict(enumerate(growing.observed)), growing.places, rng, sigma_m)


def run_localizer(
    session: Session, frames: list[RectifiedFrame], tiles: list[Tile], vocabulary: Vocabulary
) -> list[Estimate]:
    """The localizer's estimates over pictures in a map."""
    rectifier, nominal = Rectifier(session.nominal), session.nominal
    offset_s = nominal.cameras[0].imu_minus_cam_s
    localizer = Localizer(nominal, rectifier.camera, rectifier.body_from_cam, offset_s, LocalizerSettings())
    localizer.handle_version(1, tiles, vocabulary, rectifier.camera.focal_px)
    estimates, last_ns = [], 0
    for frame in frames:
        localizer.handle_imu(session.imu.between(last_ns, frame.stamp_ns + 1))
        last_ns = frame.stamp_ns + 1
        estimates.append(localizer.handle_stereo(frame))
    return estimates
