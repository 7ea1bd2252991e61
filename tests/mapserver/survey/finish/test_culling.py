"""What a survey does not hand on: doubles, landmarks without parallax, keyframes that repeat each other."""

from dataclasses import replace

import numpy as np

from fleetmap import core
from fleetmap.features.matching import packed
from fleetmap.geometry import Array
from mapserver.survey.finish.map_assembly import cull, parallax_rad, redundant
from mapserver.survey.settings import CullSettings
from mapserver.survey.state import Landmarks
from support.worlds.corridor_scene import CAMERA, plain_keyframes, plain_marks, scene


def seen_by(table: Array, landmarks: int) -> Landmarks:
    """Observations (landmark, keyframe), sorted."""
    return plain_marks(table[:, ::-1], np.zeros((landmarks, 3)))


def test_keyframes_that_repeat_each_other_do_not_all_go() -> None:
    """Eight keyframes see the same forty landmarks: each goes while three others see them, so three stay, the ends among them."""
    table = np.array([(n, k) for n in range(40) for k in range(8)])
    lasting = np.ones(40, bool)
    gone = redundant(seen_by(table, 40), np.zeros(len(table), np.int8), lasting, 8, CullSettings())
    assert gone.sum() == 5
    assert not gone[[0, 7]].any()
    # Keyframe 3 sees at octave 0 what the others see at octave 4: from farther, or as larger corners.
    finer = redundant(seen_by(table, 40), np.where(table[:, 1] == 3, 0, 4).astype(np.int8), lasting, 8, CullSettings())
    assert not finer[3]
    assert finer.sum() >= 3
    few = np.array([(n, k) for n in range(40) for k in sorted({n % 8, (n + 1) % 8})])
    assert not redundant(seen_by(few, 40), np.zeros(len(few), np.int8), lasting, 8, CullSettings()).any()


def test_a_double_goes_and_its_neighbours_stay() -> None:
    """A landmark's observations are split in two, as if a track had broken: one of the two goes, with a like descriptor only."""
    state = scene(12, 1, drift=0.0).state
    marks = state.landmarks
    counts = np.bincount(marks.obs_landmark)
    split = int(np.argmax(counts))
    rows = np.flatnonzero(marks.obs_landmark == split)[counts[split] // 2 + 1 :]
    landmark = marks.obs_landmark.copy()
    landmark[rows] = len(counts)
    order = np.argsort(landmark, kind="stable")
    broken = Landmarks(
        np.vstack([marks.points_map, marks.points_map[split]]), marks.obs_keyframe[order], marks.obs_camera, landmark[order],
        marks.obs_feature[order], marks.obs_pixels[order], marks.obs_sigma_px[order],
    )  # fmt: skip
    frames = plain_keyframes([0] * 12, int(marks.obs_feature.max()) + 1, np.random.default_rng(0))
    sigmas = np.full(len(counts) + 1, 0.01)
    settings = CullSettings(min_parallax_deg=0.0, redundant_share=1.1)
    _, kept, none = cull(replace(state, landmarks=broken), frames, sigmas, settings)
    assert none.landmarks_merged == 0  # random descriptors: not the same thing
    assert kept.all()
    first = np.flatnonzero(landmark[order] == split)[0]
    second = np.flatnonzero(landmark[order] == len(counts))[0]
    theirs = frames[broken.obs_keyframe[second]].features.descriptors
    theirs[broken.obs_feature[second]] = frames[broken.obs_keyframe[first]].features.descriptors[
        broken.obs_feature[first]
    ]
    seen, _, culled = cull(replace(state, landmarks=broken), frames, sigmas, settings)
    assert culled.landmarks_merged == 1
    assert len(np.unique(broken.obs_landmark[seen])) == len(counts)


def test_parallax_is_the_widest_angle_or_the_baselines() -> None:
    state = scene(12, 2, drift=0.0).state
    angles = parallax_rad(state)
    map_from_cam = state.map_from_cams[:, 0]
    for n in range(0, len(state.landmarks.points_map), 17):
        own = state.landmarks.obs_landmark == n
        rays = map_from_cam[state.landmarks.obs_keyframe[own], :3, 3] - state.landmarks.points_map[n]
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        widest = np.arccos(np.clip(rays @ rays[0], -1, 1)).max()
        nearest = np.linalg.norm(
            map_from_cam[state.landmarks.obs_keyframe[own], :3, 3] - state.landmarks.points_map[n], axis=1
        ).min()
        assert np.isclose(angles[n], max(widest, CAMERA.baseline_m / nearest), atol=1e-9)


def test_the_medoid_is_the_nearest_to_all_others() -> None:
    rng = np.random.default_rng(4)
    rows = rng.integers(0, 256, (40, 32)).astype(np.uint8)
    starts = np.array([0, 1, 4, 20, 40])
    chosen = core.medoids(packed(rows), starts)
    for n in range(4):
        own = np.unpackbits(rows[starts[n] : starts[n + 1]], axis=1).astype(int)
        total = np.abs(own[:, None] - own[None]).sum(axis=(1, 2))
        assert chosen[n] == starts[n] + int(np.argmin(total))


def test_only_what_could_be_one_landmark_is_a_duplicate() -> None:
    """Five near pairs: alike; unlike; too far for their sigmas; seen side by side; alike again, the less observed one goes."""
    rng = np.random.default_rng(5)
    words = np.repeat(rng.integers(0, 256, (5, 32)).astype(np.uint8), 2, axis=0)
    words[3] = ~words[3]
    points = np.repeat(10.0 * np.arange(5.0), 2)[:, None] * np.ones(3)
    points[1::2] += 0.01
    points[5] += 0.2
    keyframes = [[0, 1], [2], [0, 1], [2], [0, 1], [2], [0, 1], [1, 2], [0], [2, 3]]
    starts = np.cumsum([0, *(len(k) for k in keyframes)])
    double = core.duplicate_landmarks(
        np.arange(10).reshape(5, 2), points, np.full(10, 0.02), starts, np.concatenate(keyframes).astype(np.int32),
        packed(words), 50,
    )  # fmt: skip
    assert np.flatnonzero(double).tolist() == [1, 8]
