"""A made-up survey along a corridor of points, as it comes from odometry, with its truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.features.orb import Features
from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp, transform_points
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples
from mapserver.survey.rig import Rig
from mapserver.survey.state import ImageStore, Keyframe, KeyframeMotion, Landmarks, SurveyState

CAMERA = StereoCamera(300.0, 320.0, 240.0, 0.12, 640, 480)
BODY_FROM_CAM = se3(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.array([0.1, 0.05, 0.2]))
SIGMA_PX, SIGMA_DISPARITY_PX = 0.3, 0.15


@dataclass
class Scene:
    """A survey as it comes from odometry, and what is true."""

    state: SurveyState
    map_from_body: Array
    points_map: Array
    is_outlier: Array


def scene(keyframes: int, seed: int, *, drift: float, outliers: float = 0.0, landmarks: int | None = None) -> Scene:
    """A drive along a corridor of points, 25 a keyframe unless told; odometry is off by `drift` (m; a tenth of it in rad) each step."""
    rng = np.random.default_rng(seed)
    step = se3(so3_exp(np.array([0, 0, 0.01])), np.array([0.3, 0, 0]))
    true, guess = [np.eye(4)], [np.eye(4)]
    for _ in range(keyframes - 1):
        error = se3_exp(rng.normal(0, drift, 6) * [0.1, 0.1, 0.1, 1, 1, 1])
        true.append(true[-1] @ step)
        guess.append(guess[-1] @ step @ error)
    map_from_body, guessed = np.array(true), np.array(guess)
    along = map_from_body[rng.integers(0, keyframes, landmarks or 25 * keyframes), :3, 3]
    ahead = rng.uniform(2, 8, len(along))
    aside = rng.choice([-2.0, 2.0], len(along)) * rng.uniform(0.5, 1, len(along))
    points = along + np.column_stack([ahead, aside, rng.uniform(-1, 1.5, len(along))])
    rows = []
    for k in range(keyframes):
        seen = transform_points(se3_inverse(map_from_body[k] @ BODY_FROM_CAM), points)
        pixels = CAMERA.pixel_from_point(seen)
        visible = (seen[:, 2] > 1) & (seen[:, 2] < 10) & (pixels > 0).all(axis=1)
        visible &= (pixels[:, 0] < CAMERA.width_px) & (pixels[:, 1] < CAMERA.height_px)
        rows += [(n, k, *pixels[n]) for n in np.flatnonzero(visible)]
    table = np.array(sorted(rows))
    counts = np.bincount(table[:, 0].astype(int), minlength=len(points))
    lasting = counts >= 3
    number = np.cumsum(lasting) - 1
    table = table[lasting[table[:, 0].astype(int)]]
    points = points[lasting]
    landmark, keyframe = number[table[:, 0].astype(int)].astype(np.int32), table[:, 1].astype(np.int32)
    noise = rng.normal(0, SIGMA_PX, (len(table), 3))
    noise[:, 2] = noise[:, 0] - rng.normal(0, SIGMA_DISPARITY_PX, len(table))
    is_outlier = rng.random(len(table)) < outliers
    noise[is_outlier, :2] += rng.choice([-1, 1], (is_outlier.sum(), 2)) * rng.uniform(8, 40, (is_outlier.sum(), 2))
    noise[is_outlier, 2] = noise[is_outlier, 0]
    first = np.r_[True, np.diff(landmark) > 0]
    reference = keyframe[first]
    moved = guessed[reference] @ se3_inverse(map_from_body[reference])
    started = np.einsum("nij,nj->ni", moved[:, :3, :3], points) + moved[:, :3, 3]
    marks = Landmarks(
        started, keyframe, np.zeros_like(keyframe), landmark, np.arange(len(table), dtype=np.int32), table[:, 2:] + noise,
        np.tile([SIGMA_PX, SIGMA_DISPARITY_PX], (len(table), 1)),
    )  # fmt: skip
    motion = KeyframeMotion(False, ImuSamples.empty(), None, 0.0, np.zeros((keyframes, 9)), [])
    stamps = np.arange(keyframes, dtype=np.int64) * 100_000_000
    return Scene(
        SurveyState(stamps, guessed.copy(), Rig.of_one(CAMERA, BODY_FROM_CAM), motion, marks),
        map_from_body,
        points,
        is_outlier,
    )


def neighbour_errors_m(given: Scene) -> Array:
    """(K - 1,) how far the motion between neighbours is from the true one."""
    found, true = given.state.map_from_body, given.map_from_body
    steps = [se3_inverse(m[:-1]) @ m[1:] for m in (found, true)]
    return np.linalg.norm(steps[0][:, :3, 3] - steps[1][:, :3, 3], axis=1)


def plain_marks(pairs: Sequence[tuple[int, int]], points_map: Array) -> Landmarks:
    """Landmarks (N, 3) as pairs of a keyframe and a landmark see them, each by a feature of its own, without pixels."""
    keyframe, landmark = np.ascontiguousarray(np.array(pairs, np.int32).reshape(-1, 2).T)
    rows, none = np.arange(len(pairs), dtype=np.int32), np.zeros((len(pairs), 5))
    return Landmarks(points_map, keyframe, np.zeros_like(keyframe), landmark, rows, none[:, :3], none[:, 3:] + 1.0)


def plain_keyframes(octaves: list[int], features: int, rng: np.random.Generator | None = None) -> list[Keyframe]:
    """One for each octave, which all its features have, with random descriptors or with all alike; no pictures."""
    pixels, angles, places = np.zeros((features, 2)), np.zeros(features, np.float32), np.zeros((features, 3))
    words = np.zeros((len(octaves), features, 32), np.uint8)
    words = words if rng is None else rng.integers(0, 256, words.shape, dtype=np.uint8)
    kinds = [
        Features(pixels, np.full(features, octave, np.int8), angles, own)
        for octave, own in zip(octaves, words, strict=True)
    ]
    return [Keyframe(k, k, kind, np.zeros((features, 2)), places, ImageStore(), 0) for k, kind in enumerate(kinds)]
