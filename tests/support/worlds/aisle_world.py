"""An aisle of points that look like themselves: maps of it and sessions in it, as the test of joining takes them. No pictures."""

from collections.abc import Sequence
from itertools import pairwise, repeat
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.features.orb import SCALE_FACTOR, Features
from fleetmap.geometry import Array, se3, se3_inverse, transform_points
from fleetmap.mapformat.tile import Tile
from fleetmap.relocalization.map_view import MapView
from fleetmap.relocalization.relocalizer import FrameFeatures, Relocalizer
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.merge.confirmation import firm_landmarks
from mapserver.survey.merge.guided_matching import session_relocalization
from mapserver.survey.merge.membership import MembershipTest, SessionKeyframes
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.settings import SurveySettings

CAMERA = StereoCamera(400.0, 320.0, 240.0, 0.12, 640, 480)
BODY_FROM_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
SETTINGS = SurveySettings()
STEP_M = 0.4
_ONE = np.eye(4)[None]
_STEP_COV = np.diag([0.003**2] * 3 + [0.015**2] * 3)


class Aisle(NamedTuple):
    """Corners on both sides of an aisle: points_map (N, 3), descriptors (N, 32), and reaches_m (N,) from which each is found."""

    points_map: Array
    descriptors: NDArray[np.uint8]
    reaches_m: Array

    def look(self, map_from_cam: Array) -> tuple[NDArray[np.int64], Array, NDArray[np.int8]]:
        """Rows (V,) of what a camera there may see, their pixels (V, 3) and octaves (V,)."""
        points_cam = transform_points(se3_inverse(map_from_cam), self.points_map)
        distances = np.linalg.norm(points_cam, axis=1)
        rows = np.flatnonzero((points_cam[:, 2] > 0.5) & (distances < self.reaches_m))
        pixels = CAMERA.pixel_from_point(points_cam[rows])
        inside = (np.abs(pixels[:, :2] - [320, 240]) < [315, 235]).all(axis=1)
        octaves = np.log(self.reaches_m[rows] / distances[rows]) / np.log(SCALE_FACTOR)
        return rows[inside], pixels[inside], np.clip(np.rint(octaves[inside]), 0, 7).astype(np.int8)


def aisle(seed: int, *, length_m: float = 24.0, y_m: float = 0.0, count: int = 3000) -> Aisle:
    """The corners of one building's aisle; y_m moves it, what it looks like stays."""
    rng = np.random.default_rng(seed)
    side = np.where(rng.random(count) < 0.5, -1.5, 1.5) + rng.uniform(-0.2, 0.2, count)
    points = np.column_stack([rng.uniform(0, length_m + 4.0, count), side + y_m, rng.uniform(-1.0, 2.0, count)])
    return Aisle(points, rng.integers(0, 256, (count, 32), np.uint8), rng.uniform(5.0, 10.0, count))


def repainted(one: Aisle, other: Aisle, changed: NDArray[np.bool_]) -> Aisle:
    """The first, with the other's looks where `changed` (N,)."""
    return Aisle(one.points_map, np.where(changed[:, None], other.descriptors, one.descriptors), one.reaches_m)


def drive(count: int = 30, start_m: float = 1.0, y_m: float = 0.0) -> Array:
    """map_from_body (K, 4, 4) along the aisle."""
    return np.stack([se3(np.eye(3), np.array([start_m + STEP_M * k, y_m, 0.02 * np.sin(k)])) for k in range(count)])


def relocalizer(seen: Aisle, map_from_body: Array) -> tuple[Relocalizer, NDArray[np.bool_]]:
    """The map that a survey along these places makes, and its firm landmarks."""
    map_from_cam = map_from_body @ BODY_FROM_CAM
    members = [seen.look(place)[0] for place in map_from_cam]
    known = np.unique(np.concatenate(members))
    towards = np.zeros((len(seen.points_map), 3))
    for place, rows in zip(map_from_cam, members, strict=True):
        ray = place[:3, 3] - seen.points_map[rows]
        towards[rows] += ray / np.linalg.norm(ray, axis=1, keepdims=True)
    directions = towards[known] / np.linalg.norm(towards[known], axis=1, keepdims=True)
    lists = tuple(np.searchsorted(known, rows).astype(np.uint32) for rows in members)
    count = len(known)
    tile = Tile(
        0, 0, np.inf, np.arange(count, dtype=np.uint32), seen.points_map[known], seen.descriptors[known], directions.astype(np.float32),
        np.full(count, 0.5, np.float32), seen.reaches_m[known].astype(np.float32), np.full(count, 0.005, np.float32),
        np.arange(len(members), dtype=np.uint32), map_from_cam, lists,
    )  # fmt: skip
    view = MapView([tile], default_vocabulary(), CAMERA.focal_px)
    firm = firm_landmarks(count, np.concatenate(lists).astype(np.int32))
    return Relocalizer(view, CAMERA, session_relocalization(SETTINGS)), firm


def frame(seen: Aisle, map_from_body: Array, rng: np.random.Generator) -> FrameFeatures:
    """Features of an image from there: most corners, with errors of half a pixel and a dozen bits."""
    rows, pixels, octaves = seen.look(map_from_body @ BODY_FROM_CAM)
    found = rng.random(len(rows)) < 0.8
    rows, pixels, octaves = (
        rows[found],
        pixels[found] + rng.normal(0, [0.4, 0.4, 0.0], (found.sum(), 3)),
        octaves[found],
    )
    pixels[:, 2] += rng.normal(0, 0.3, len(rows))
    flips = np.packbits(rng.random((len(rows), 256)) < 0.05, axis=1)
    features = Features(pixels[:, :2].copy(), octaves, np.zeros(len(rows), np.float32), seen.descriptors[rows] ^ flips)
    return FrameFeatures(features, pixels)


def membership(
    known: tuple[Relocalizer, NDArray[np.bool_]],
    seen: Aisle | Sequence[Aisle],
    map_from_body: Array,
    docks_map_from_survey: Array | None,
    seed: int = 0,
    body_from_others: Array = _ONE,
) -> MembershipTest:
    """The test of a session along these places in an aisle; its own frame begins at its first keyframe, and drifts.

    seen: what each place shows, where it is not the same from all. body_from_others (V, 4, 4): bodies whose first
    camera would see what the rig's cameras see.
    """
    rng = np.random.default_rng([7, seed])
    survey_from_body, chain = [np.eye(4)], []
    for k, (a, b) in enumerate(pairwise(map_from_body)):
        step = se3_inverse(a) @ b
        step[:3, 3] += rng.normal(0, 0.005, 3)
        survey_from_body.append(survey_from_body[-1] @ step)
        chain.append(PoseEdge(k, k + 1, step, _STEP_COV, is_loop=False))
    shown = repeat(seen) if isinstance(seen, Aisle) else seen
    frames = [
        [frame(one, place @ body_from_other, rng) for body_from_other in body_from_others]
        for one, place in zip(shown, map_from_body, strict=False)
    ]
    cameras = CAMERA, body_from_others @ BODY_FROM_CAM
    visit = SessionKeyframes(frames, np.stack(survey_from_body), chain, *cameras, docks_map_from_survey)
    return MembershipTest(*known, visit, SETTINGS.sessions)
