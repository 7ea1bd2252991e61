"""Thirty nights of the study's site without pictures: how often are the robots of the next day localised in what the budget chose?

Sessions come from `support.estimator`. Which landmarks of the map they expect and miss, what fades, what is new and what a version holds
is the product's own code; what is left out is the odometry of the surveys and their adjustment: keyframes stand at their true places,
and a landmark of the map is found where the detector found it. Light hides a share of all landmarks by day and another in the evening.

Each day three robots wake in three aisles and drive twice: with the one set of landmarks that the product chooses, and with a set of the
same size for the light of that day, in which what surveys in that light saw comes first.

    PYTHONPATH=tests python tests/benchmarks/maps/bench_simulated_nights.py [--seed 611] [--nights 30] [--every 1] [--out FILE.json]
"""

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.estimator_loop import is_new_place, map_view, run_localizer
from benchmarks.common.simulated_survey import GreyPictures, _keyframe
from fleetmap.bow import Vocabulary
from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.geometry import Array
from fleetmap.mapformat import decode_tile, encode_tile
from fleetmap.messages import Status
from fleetmap.sensors.samples import SensorSet, Trajectory
from fleetsim.recorder import Order, prepare
from fleetsim.scenarios import SCENARIOS
from mapserver.config import survey_settings
from mapserver.survey.finish.map_assembly import medoid_descriptors
from mapserver.survey.keyframes.keyframes import Keyframe
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.confirmation import EDGE_PX, WIDER_VIEW_RAD
from mapserver.survey.merge.guided_matching import Sighting
from mapserver.survey.merge.initial_history import history_of
from mapserver.survey.merge.joint_adjustment import Joint, free_observations
from mapserver.survey.merge.landmark_persistence import count_landmarks, faded
from mapserver.survey.merge.merge import Change, SessionFrames, chosen, fewer_keyframes, merged
from mapserver.survey.merge.new_landmarks import new_landmarks
from mapserver.survey.survey_map import SurveyMap
from mapserver.survey.tracks.tracks import Landmarks
from mapserver.tiles.landmark_budget import choose_landmarks
from mapserver.tiles.tiling import TILE_SIZE_M, tiles_from_survey
from studies.thirty_nights import CLOSED, DARK, NIGHTS, SCENARIO, scenario
from support.estimator.simulated_run import EstimatorSession, Found
from support.worlds.vocabulary_training import train_vocabulary

SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)
EVENINGS = range(10, 20)
TOURS = ((0, 3, 4), (2, 5, 0), (4, 1, 2))  # aisles of the three robots
SEEN_LATELY = 6  # surveys of a light: two of every third of the site
HELD = (DARK, *(night for night in CLOSED if night % 3 == 1))  # as the rendered study's nights were
HIDDEN_SHARE = 0.3  # of all landmarks, in either light; an assumption
FOUND_SHARE = (
    0.35  # of landmarks by a robot, of 0.72 in sharp pictures: it drives at 2 m/s with motion blur; an assumption
)
WRONG_M = 0.3
_EVERY_M, _SIGMA_M, _CORNER_PX, _DISPARITY_PX = 0.5, 0.005, 0.4, 0.3
_HASH = np.uint64(0x9E3779B97F4A7C15)


def is_hidden(ids: NDArray[np.uint64], night: int) -> NDArray[np.bool_]:
    """(N,) landmarks that the light of a night does not show."""
    drawn = ((ids * _HASH) >> np.uint64(40)).astype(np.float64) / 2.0**24
    return np.asarray(drawn < HIDDEN_SHARE if night in EVENINGS else drawn > 1.0 - HIDDEN_SHARE)


class LitSession(EstimatorSession):
    """A session in which the features of hidden landmarks show something else."""

    night = 0

    def features(self, frame: int) -> Found:
        """As the session's."""
        found, ids = super().features(frame), self.sighting(frame).ids
        real = np.flatnonzero(found.rows >= 0)
        hidden = real[is_hidden(ids[found.rows[real]], self.night)]
        rows, descriptors = found.rows.copy(), found.descriptors.copy()
        rows[hidden] = -1
        rng = np.random.default_rng([self._seed, frame])
        descriptors[hidden] = rng.integers(0, 256, (len(hidden), 32), dtype=np.uint8)
        return Found(rows, found.pixels, found.octaves, descriptors)


class Visit(NamedTuple):
    """A survey's session with K keyframes at their true places map_from_body (K, 4, 4), and the landmark of each feature, 0 for none."""

    session: LitSession
    keyframes: list[Keyframe]
    ids: list[NDArray[np.uint64]]
    map_from_body: Array

    @property
    def frames(self) -> SessionFrames:
        """For a merge: the keyframes alone."""
        stamps_ns = np.array([k.stamp_ns for k in self.keyframes], np.int64)
        return SessionFrames(self.keyframes, Trajectory(stamps_ns, self.map_from_body), np.ones(len(stamps_ns), bool))


def session_of(night: int, run: str, seed: int, aisles: tuple[int, int, int] = TOURS[0]) -> LitSession:
    """The survey of a night, or a robot of the day after it in these aisles."""
    SCENARIOS[SCENARIO] = partial(scenario, night, aisles)
    try:
        session = prepare(Order(SCENARIO, seed=seed, day=night + (run == "robot"), robot=f"{run}-{night}"))
    finally:
        del SCENARIOS[SCENARIO]
    session.renderer.close()
    lit = LitSession(session)
    lit.night = night
    return lit


def visit_of(night: int, seed: int) -> Visit:
    """The keyframes of a night's survey."""
    session, images = session_of(night, "survey", seed), GreyPictures()
    keyframes, ids, places = list[Keyframe](), list[NDArray[np.uint64]](), list[Array]()
    for frame, map_from_body in enumerate(session.map_from_body):
        if not places or is_new_place(places[-1], map_from_body, _EVERY_M):
            keyframe, shown, _ = _keyframe(session, frame, images)
            keyframes.append(keyframe)
            ids.append(shown)
            places.append(map_from_body)
    return Visit(session, keyframes, ids, np.array(places))


def own_landmarks(visit: Visit, rng: np.random.Generator) -> tuple[Landmarks, NDArray[np.uint64]]:
    """What two keyframes of a survey and more see, near where it stands, and the landmark's id in the simulator."""
    keyframe = np.repeat(np.arange(len(visit.ids), dtype=np.int32), [len(ids) for ids in visit.ids])
    feature = np.concatenate([np.arange(len(ids)) for ids in visit.ids])
    ids, landmark = np.unique(np.concatenate(visit.ids), return_inverse=True)
    _, first = np.unique(landmark * len(visit.ids) + keyframe, return_index=True)  # by landmark, then keyframe
    first = first[ids[landmark[first]] > 0]
    keyframe, feature, shown_of = keyframe[first], feature[first], landmark[first].astype(np.int32)
    shown = [measured(visit.keyframes[k], feature[keyframe == k]) for k in range(len(visit.ids))]
    pixels, sigmas = np.empty((len(first), 3)), np.empty((len(first), 2))
    for k, (seen_px, sigmas_px) in enumerate(shown):
        pixels[keyframe == k], sigmas[keyframe == k] = seen_px, sigmas_px
    points = np.full((len(ids), 3), np.nan)
    for own in visit.keyframes:
        sighting = visit.session.sighting(own.frame_index)
        _, rows, seen = np.intersect1d(ids, sighting.ids, return_indices=True)
        points[rows] = sighting.points_map[seen]
    points += rng.normal(0.0, _SIGMA_M, points.shape)
    marks = Landmarks(points, keyframe, shown_of, feature, pixels, sigmas)
    kept = np.bincount(shown_of, minlength=len(ids)) >= 2
    return marks.keep_observations(np.ones(len(first), bool), 2), ids[kept]


def measured(keyframe: Keyframe, features: NDArray[np.int64]) -> tuple[Array, Array]:
    """Pixels (P, 3) of features as a map keeps them, and their sigmas (P, 2)."""
    left = keyframe.features.pixels[features]
    pixels = np.column_stack([left, left[:, 0] - keyframe.disparities[features, 0]])
    corner_px = _CORNER_PX * SCALE_FACTOR ** keyframe.features.octaves[features].astype(np.float64)
    return pixels, np.column_stack([corner_px, np.full(len(features), _DISPARITY_PX)])


@dataclass
class Nights:
    """The map of a site as its nights leave it, and which landmark of the simulator each of its ids is."""

    survey: SurveyMap
    simulated: dict[int, int]
    rng: np.random.Generator
    seen: dict[int, NDArray[np.uint32]]  # by night, ids of what its survey saw

    def seen_in_light_of(self, night: int) -> NDArray[np.uint32]:
        """Ids of what the last surveys in the light of a night saw together."""
        alike = [n for n in sorted(self.seen) if (n in EVENINGS) == (night in EVENINGS)][-SEEN_LATELY:]
        return np.unique(np.concatenate([np.zeros(0, np.uint32), *(self.seen[n] for n in alike)]))

    @classmethod
    def begun(cls, visit: Visit, rng: np.random.Generator) -> "Nights":
        """The first survey's map."""
        marks, ids = own_landmarks(visit, rng)
        frames, count = visit.frames, len(ids)
        octaves = [
            visit.keyframes[k].features.octaves[f] for k, f in zip(marks.obs_keyframe, marks.obs_feature, strict=True)
        ]
        survey = SurveyMap(
            visit.session.camera, visit.session.body_from_cam, frames.trajectory.stamps_ns, visit.map_from_body,
            np.arange(count, dtype=np.uint32), marks.points_map, medoid_descriptors(marks, visit.keyframes), np.full(count, 2 * _SIGMA_M),
            marks.obs_keyframe, marks.obs_landmark, marks.obs_pixels, np.array(octaves, np.int8), marks.obs_sigma_px,
            frames.trajectory, frames.estimated, np.zeros((count, 21, 21), np.uint8),
        )  # fmt: skip
        return cls(survey, dict(enumerate(ids.tolist())), rng, {0: survey.landmark_ids})

    def vocabulary(self) -> Vocabulary:
        """Trained on this map."""
        shown_in = np.zeros(len(self.survey.landmark_ids), np.int64)
        shown_in[self.survey.obs_landmark] = self.survey.obs_keyframe
        return train_vocabulary(self.survey.descriptors, 10, 4, self.rng, shown_in)

    def add(self, visit: Visit) -> None:
        """A night's survey."""
        base = BaseMap(self.survey, visit.session.camera, visit.session.body_from_cam)
        map_from_cam = visit.map_from_body @ visit.session.body_from_cam
        sightings = self._sightings(base, visit, map_from_cam)
        marks, ids = own_landmarks(visit, self.rng)
        counts = count_landmarks(base, visit.keyframes, map_from_cam, sightings)
        gone, free = faded(base, counts, SETTINGS), free_observations(marks, sightings)
        nobody = np.zeros(0, np.int64)
        joint = Joint(
            visit.map_from_body, nobody, np.zeros((0, 4, 4)), nobody, np.zeros((0, 3)), marks.points_map, sightings
        )
        fresh = new_landmarks(base, visit.keyframes, marks, joint, free, SETTINGS.sessions)
        added = fewer_keyframes(chosen(marks, marks.points_map, fresh, free), SETTINGS.sessions.min_confirmations)
        rows = np.full(int(fresh.sum()), -1)
        change = Change(~gone, self.survey.points_map, self.survey.map_from_body, added, rows, map_from_cam)
        first = base.history.next_landmark_id
        seen = [self.survey.landmark_ids[s.rows] for s in sightings if s is not None]
        self.seen[visit.session.night] = np.concatenate([*seen, np.arange(first, first + len(rows), dtype=np.uint32)])
        self.survey = merged(base, change, counts, visit.frames, SETTINGS.sessions.new_place_landmarks)
        self.simulated |= dict(zip(range(first, first + len(rows)), ids[fresh].tolist(), strict=True))

    def _sightings(self, base: BaseMap, visit: Visit, map_from_cam: Array) -> list[Sighting | None]:
        known = np.array([self.simulated[number] for number in self.survey.landmark_ids.tolist()], np.uint64)
        found = list[Sighting | None]()
        for keyframe, ids, place in zip(visit.keyframes, visit.ids, map_from_cam, strict=True):
            visible = base.visible(place, -EDGE_PX, WIDER_VIEW_RAD).rows
            shown = np.flatnonzero(ids > 0)
            _, at, of = np.intersect1d(known[visible], ids[shown], return_indices=True)
            enough = len(at) >= SETTINGS.sessions.min_inliers
            found.append(Sighting(visible[at], shown[of], *measured(keyframe, shown[of])) if enough else None)
        return found


class Version(NamedTuple):
    """A night's map, and which (N,) of its landmarks robots get: one set, or one for the light of the next day."""

    survey: SurveyMap
    sets: dict[str, NDArray[np.bool_]]
    vocabulary: Vocabulary


def versions(seed: int, last: int) -> Iterator[tuple[int, Version]]:
    """Each night and its map."""
    nights = Nights.begun(visit_of(0, seed), np.random.default_rng(seed))
    vocabulary, before, wanted = nights.vocabulary(), None, None
    robots_have = np.zeros(0, np.uint32)
    for night in range(last + 1):
        if night and night not in HELD:
            nights.add(visit_of(night, seed))
        survey = nights.survey
        if survey is not before:
            if before is not None:
                is_new = survey.landmark_ids >= history_of(before).next_landmark_id
                wanted = np.union1d(robots_have, survey.landmark_ids[is_new])
            is_chosen = choose_landmarks(survey, SETTINGS.budget, TILE_SIZE_M, wanted)
            robots_have, before = survey.landmark_ids[is_chosen], survey
        of_light = choose_landmarks(survey, SETTINGS.budget, TILE_SIZE_M, nights.seen_in_light_of(night))
        yield night, Version(survey, {"one": is_chosen, "of its light": of_light}, vocabulary)


def next_day(night: int, seed: int, version: Version, name: str, aisles: tuple[int, int, int]) -> dict[str, Any]:
    """A robot that wakes in the first of these aisles on the day after a night, with one of the version's sets."""
    survey, is_chosen = version.survey, version.sets[name]
    tiles = [encode_tile(tile) for tile in tiles_from_survey(survey, chosen=is_chosen)]
    decoded = [decode_tile(data) for data in tiles]
    robot = session_of(night, "robot", seed, aisles)
    robot._features = robot._features._replace(found_share=FOUND_SHARE)
    estimates = run_localizer(robot, map_view(robot, decoded, version.vocabulary), has_wheels=True)
    tracking = np.array([e.status is Status.TRACKING for e in estimates])
    start = int(np.argmax(tracking)) if tracking.any() else len(tracking)
    pairs = zip(estimates, robot.map_from_body, strict=True)
    errors_m = np.array(
        [np.inf if e.map_from_body is None else np.linalg.norm(e.map_from_body[:3, 3] - t[:3, 3]) for e, t in pairs]
    )
    median_m = float(np.median(errors_m[tracking])) if tracking.any() else np.nan
    return {
        "night": night, "set": name, "aisle": aisles[0], "frames": len(tracking),
        "localised_share": float(tracking.mean()), "median_mm": 1e3 * median_m, "start_frames": start,
        "lost_later": int((~tracking[start:]).sum()), "wrong_frames": int((errors_m[tracking] > WRONG_M).sum()),
        "kb": sum(map(len, tiles)) / 1e3, "landmarks": int(is_chosen.sum()),
        "places": sum(len(tile.place_ids) for tile in decoded), "keyframes": len(survey.map_from_body),
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """A line for each night, and all of them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=611)
    parser.add_argument("--nights", type=int, default=NIGHTS)
    parser.add_argument("--every", type=int, default=1, help="days on which robots drive: each such many-th")
    parser.add_argument("--out", type=Path)
    options, rows, begun_s = parser.parse_args(arguments), list[dict[str, Any]](), time.process_time()
    for night, version in versions(options.seed, options.nights):
        for name in version.sets if night % options.every == 0 else ():
            for aisles in TOURS:
                rows.append(next_day(night, options.seed, version, name, aisles))
                said = (
                    f"{key} {value if isinstance(value, str) else f'{value:.4g}'}" for key, value in rows[-1].items()
                )
                print("  ".join(said), flush=True)
    print(f"{time.process_time() - begun_s:.0f} CPU s")
    if options.out is not None:
        options.out.write_text(json.dumps({"seed": options.seed, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
