"""The map that a survey makes of the site where loops are believed for their looks: nobody asks where the robot can be.

Keyframes along the survey's route, odometry with drift, and for each keyframe the one loop that looks best. Between racks every aisle looks
like every other, so which aisle that names is chance. The pose graph keeps its robust kernel. Places and landmarks of the true map then
move as the keyframe did that saw them first.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np

from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp
from fleetmap.relocalization.map_view import MapView
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from studies.robot_days.site import LAYOUT, survey_route, surveyed_site

_HEADING_RAD, _STEP_M = np.radians(0.05), 0.005  # of the odometry, at each metre: an assumption
_LOOP_COV = np.diag([np.radians(0.2) ** 2] * 3 + [0.02**2] * 3)
_LATER, _NEAR_M = 30, 0.6  # keyframes after which a loop is one, and how far off a view still is the same
_HALF_AISLE_M = 0.6


def keyframes() -> Array:
    """(K, 4, 4) one at every metre of the survey's route, facing ahead."""
    places = []
    for a, b in pairwise(survey_route().way_points_map):
        begin, way = np.array([*a, 0.0]), np.array([*b, 0.0]) - [*a, 0.0]
        facing = so3_exp(np.array([0.0, 0.0, np.arctan2(way[1], way[0])]))
        length_m = int(np.linalg.norm(way))
        places += [se3(facing, begin + way * n / max(length_m, 1)) for n in range(length_m)]
    return np.array(places)


def loops(truth: Array, rng: np.random.Generator) -> tuple[list[PoseEdge], int]:
    """For each keyframe one of the earlier ones that look the same, and how many of these are of another aisle."""
    spots, found, wrong = truth[:, :3, 3], [], 0
    between_racks = np.array([_aisle_of(spot) is not None for spot in spots])
    for k in range(_LATER, len(truth)):
        earlier = np.arange(k - _LATER)
        off = spots[earlier] - spots[k]
        is_alike = (np.abs(off[:, 0]) < _NEAR_M) & np.isclose(truth[earlier, 0, 0], truth[k, 0, 0], atol=1e-3)
        same = is_alike & (np.abs(off[:, 1]) < _NEAR_M)
        twin = is_alike & between_racks[earlier] & between_racks[k]
        candidates = earlier[same | twin]
        if not len(candidates):
            continue
        j = int(rng.choice(candidates))
        aside_m = _aside_m(spots[j], between_racks[j]) - _aside_m(spots[k], between_racks[k])
        seen = se3_inverse(truth[k]) @ truth[j]
        seen[:3, 3] = truth[k, :3, :3].T @ [spots[j, 0] - spots[k, 0], aside_m, 0.0]
        measured = se3_exp(rng.multivariate_normal(np.zeros(6), _LOOP_COV)) @ seen
        found.append(PoseEdge(k, j, measured, _LOOP_COV, is_loop=True))
        wrong += not same[j]
    return found, wrong


def _aisle_of(spot: Array) -> int | None:
    """The aisle between whose racks a place lies."""
    if not LAYOUT.end_m < spot[0] < LAYOUT.bay_x_m(LAYOUT.bays):
        return None
    aisle = int(LAYOUT.chunk_at(float(spot[0]), float(spot[1]))[1])
    return aisle if 0 <= aisle < LAYOUT.aisles and abs(spot[1] - LAYOUT.aisle_y_m(aisle)) < _HALF_AISLE_M else None


def _aside_m(spot: Array, is_between_racks: bool) -> float:
    """From the middle of its aisle, from the site's edge elsewhere."""
    aisle = _aisle_of(spot) if is_between_racks else None
    return float(spot[1]) if aisle is None else float(spot[1] - LAYOUT.aisle_y_m(aisle))


@lru_cache(maxsize=1)
def survey_errors(seed: int) -> tuple[Array, Array, int]:
    """Keyframes as they are and as they were mapped (K, 4, 4), and the number of wrong loops that were believed."""
    rng, truth = np.random.default_rng([seed, 7003]), keyframes()
    cov = np.diag([1e-8, 1e-8, _HEADING_RAD**2, _STEP_M**2, _STEP_M**2, 1e-8])
    start, edges = [truth[0]], []
    for k in range(len(truth) - 1):
        step = se3_exp(rng.multivariate_normal(np.zeros(6), cov)) @ se3_inverse(truth[k]) @ truth[k + 1]
        edges.append(PoseEdge(k, k + 1, step, cov, is_loop=False))
        start.append(start[-1] @ step)
    found, _ = loops(truth, rng)
    graph = optimize_pose_graph(np.array(start), [*edges, *found], robust=True)
    off_m = [np.linalg.norm((truth[e.j] @ se3_inverse(e.i_from_j) - truth[e.i])[:3, 3]) for e in found]
    wrong = sum(off > 1.0 and weight > 0.5 for off, weight in zip(off_m, graph.loop_weights, strict=True))
    return truth, graph.map_from_body, wrong


@lru_cache(maxsize=1)
def ungated_view(seed: int) -> MapView:
    """The site's map as that survey would have left it."""
    site = surveyed_site(seed)
    truth, mapped, _ = survey_errors(seed)
    tile, spots = site.tile, truth[:, :2, 3]
    facing = truth[:, :2, 0]
    map_from_cam, points = tile.map_from_cam.copy(), tile.points_map.copy()
    directions, is_moved = tile.view_directions_map.copy(), np.zeros(len(points), bool)
    for place, map_from_place in enumerate(tile.map_from_cam):
        apart = np.linalg.norm(spots - map_from_place[:2, 3], axis=1) + 2.0 * (facing @ map_from_place[:2, 2] < 0.5)
        k = int(np.argmin(apart))
        mapped_from_true = mapped[k] @ se3_inverse(truth[k])
        map_from_cam[place] = mapped_from_true @ map_from_place
        rows = np.searchsorted(tile.landmark_ids, tile.place_landmark_ids[place])
        rows = rows[~is_moved[rows]]
        points[rows] = points[rows] @ mapped_from_true[:3, :3].T + mapped_from_true[:3, 3]
        directions[rows] = directions[rows] @ mapped_from_true[:3, :3].T.astype(np.float32)
        is_moved[rows] = True
    warped = replace(tile, map_from_cam=map_from_cam, points_map=points, view_directions_map=directions)
    return MapView([warped], site.view.vocabulary, site.focal_px)
