"""Inner loops of matching two keyframes: where the features of one should appear in the other, and the motion that fits them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import Indices, Packed, by_projection
from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.pnp.pnp_kernels import refine_twice

_LOG_SCALE = np.log(1.2)
_RATIO = 0.95  # of the nearest descriptor to its rival where the motion says where to look


class PairFeatures(NamedTuple):
    """Features of a keyframe: pixels (N, 2), octaves (N,), packed descriptors (N, 4), disparities (N, 2) and the points_cam (N, 3)
    that those give; whether it measured the disparities itself."""

    pixels: Array
    octaves: NDArray[np.int8]
    words: Packed
    disparities: Array
    points_cam: Array
    measured: bool


class Guidance(NamedTuple):
    """lens: focal, cx, cy, width, height. camera: as PnP takes it. scales (128,): of the octaves, by which sigma_px grows.

    refinement: of `refine_twice`, its width, gate and iterations.
    """

    lens: Array
    camera: Array
    scales: Array
    sigma_px: float
    refinement: tuple[float, float, tuple[int, int]]
    max_distance: int


@kernel
def predict_features(
    b_from_a: Array,
    points_a: Array,
    disparities_a: Array,
    octaves_a: NDArray[np.int8],
    lens: Array,
    radius_px: float,
    predicted: Array,
    radius: Array,
    span: NDArray[np.int64],
) -> None:
    """Fills predicted (N, 2) pixels in b, radius (N,) and the octaves span (N, 2) to search; NaN pixels where a feature has no
    disparity (N,) or b cannot see it.

    b_from_a (4, 4), points_a (N, 3) as camera a sees them. lens: focal, cx, cy, width, height. Nearer, a feature appears larger
    and so on a higher octave; there pixels are coarser and the search is wider.
    """
    for n in range(len(points_a)):
        predicted[n, 0] = predicted[n, 1] = np.nan
        radius[n] = 0.0
        if not np.isfinite(disparities_a[n]):
            continue
        x, y, z = points_a[n, 0], points_a[n, 1], points_a[n, 2]
        bz = b_from_a[2, 0] * x + b_from_a[2, 1] * y + b_from_a[2, 2] * z + b_from_a[2, 3]
        if not bz > 1e-6:
            continue
        bx = b_from_a[0, 0] * x + b_from_a[0, 1] * y + b_from_a[0, 2] * z + b_from_a[0, 3]
        by = b_from_a[1, 0] * x + b_from_a[1, 1] * y + b_from_a[1, 2] * z + b_from_a[1, 3]
        u, v = lens[0] * bx / bz + lens[1], lens[0] * by / bz + lens[2]
        if not (0.0 < u < lens[3] and 0.0 < v < lens[4]):
            continue
        ratio = min(max(z / max(bz, 0.05), 0.1), 10.0)
        octave = octaves_a[n] + np.log(ratio) / _LOG_SCALE
        predicted[n, 0], predicted[n, 1] = u, v
        span[n, 0], span[n, 1] = int(np.floor(octave)) - 2, int(np.ceil(octave)) + 2
        radius[n] = radius_px * 1.2 ** min(max(octave, 0.0), 4.0)


@kernel
def share_in_view(b_from_a: Array, points_a: Array, disparities_a: Array, lens: Array) -> float:
    """Share of a's points with a disparity that b sees, at a similar distance; arguments as in `predict_features`."""
    known, seen = 0, 0
    for n in range(len(points_a)):
        if not np.isfinite(disparities_a[n]):
            continue
        known += 1
        x, y, z = points_a[n, 0], points_a[n, 1], points_a[n, 2]
        bz = b_from_a[2, 0] * x + b_from_a[2, 1] * y + b_from_a[2, 2] * z + b_from_a[2, 3]
        if not (bz > 1e-6 and 0.4 < bz / z < 2.5):
            continue
        bx = b_from_a[0, 0] * x + b_from_a[0, 1] * y + b_from_a[0, 2] * z + b_from_a[0, 3]
        by = b_from_a[1, 0] * x + b_from_a[1, 1] * y + b_from_a[1, 2] * z + b_from_a[1, 3]
        u, v = lens[0] * bx / bz + lens[1], lens[0] * by / bz + lens[2]
        seen += 0.0 < u < lens[3] and 0.0 < v < lens[4]
    return seen / known if known else 0.0


@kernel
def match_guided(a: PairFeatures, b: PairFeatures, guidance: Guidance, b_from_a: Array, radius_px: float) -> Indices:
    """(P, 2) matches of a's features with depth into b by projection."""
    count = len(a.octaves)
    predicted, radius, span = np.empty((count, 2)), np.empty(count), np.zeros((count, 2), np.int64)
    predict_features(
        b_from_a, a.points_cam, a.disparities[:, 0], a.octaves, guidance.lens, radius_px, predicted, radius, span
    )
    found, _ = by_projection(
        predicted, radius, a.words, span, b.pixels, b.octaves, b.words, guidance.max_distance, _RATIO
    )
    pairs, used = np.empty((len(found), 2), np.int64), 0
    for n in range(len(found)):
        if found[n] >= 0:
            pairs[used, 0], pairs[used, 1] = n, found[n]
            used += 1
    return pairs[:used].copy()


@kernel
def _refined(
    a: PairFeatures, b: PairFeatures, guidance: Guidance, pairs: Indices, b_from_a: Array, hessian: Array
) -> tuple[bool, Array]:
    """Whether the pairs give a motion, which is then in b_from_a; their squared residuals (P,)."""
    count = len(pairs)
    points, pixels, weights = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2))
    for n in range(count):
        i, j = pairs[n, 0], pairs[n, 1]
        points[n] = a.points_cam[i]
        disparity = b.disparities[j, 0] if b.measured else np.nan
        pixels[n, 0], pixels[n, 1], pixels[n, 2] = b.pixels[j, 0], b.pixels[j, 1], b.pixels[j, 0] - disparity
        scale = guidance.scales[b.octaves[j]]
        weights[n, 0] = 1.0 / (guidance.sigma_px * scale)
        weights[n, 1] = 1.0 / max(guidance.sigma_px, scale)
    rotation, translation = b_from_a[:3, :3].copy(), b_from_a[:3, 3].copy()
    squared = np.empty(count)
    width, gate, iterations = guidance.refinement
    prior, lens = np.zeros((6, 6)), guidance.camera
    solved = refine_twice(
        rotation, translation, points, pixels, weights, lens, width, gate, prior, iterations, hessian, squared
    )
    b_from_a[:3, :3], b_from_a[:3, 3] = rotation, translation
    return solved, squared


@kernel
def follow_motion(
    a: PairFeatures,
    b: PairFeatures,
    guidance: Guidance,
    radii_px: Array,
    least: tuple[int, float],
    found: tuple[Array, Array],
) -> tuple[int, Indices]:
    """Matches by projection and the motion from them in turn, once for each radius; how often it went well, and the last inliers (P, 2).

    least: so many inliers each time, in the first also that share of the matches. found: b_from_a (4, 4), in place, and its Hessian (6, 6).
    """
    b_from_a, hessian = found
    pairs = np.empty((0, 2), np.int64)
    for step in range(len(radii_px)):
        pairs = match_guided(a, b, guidance, b_from_a, radii_px[step])
        if len(pairs) < least[0]:
            return step, pairs
        solved, squared = _refined(a, b, guidance, pairs, b_from_a, hessian)
        inliers = np.flatnonzero(squared < guidance.refinement[1])
        wanted = max(float(least[0]), least[1] * len(pairs)) if step == 0 else float(least[0])
        if not solved or len(inliers) < wanted:
            return step, pairs
        pairs = pairs[inliers]
    return len(radii_px), pairs


@kernel
def match_both_ways(
    a: PairFeatures, b: PairFeatures, guidance: Guidance, a_from_b: Array, radius_px: float, forward: Indices
) -> NDArray[np.int32]:
    """The matches `forward` (P, 2), and those of b's features into a whose features they leave free."""
    backward = match_guided(b, a, guidance, a_from_b, radius_px)
    taken_a, taken_b = np.zeros(len(a.octaves), np.bool_), np.zeros(len(b.octaves), np.bool_)
    pairs, used = np.empty((len(forward) + len(backward), 2), np.int32), len(forward)
    for n in range(len(forward)):
        pairs[n, 0], pairs[n, 1] = forward[n, 0], forward[n, 1]
        taken_a[forward[n, 0]] = taken_b[forward[n, 1]] = True
    for n in range(len(backward)):
        i, j = backward[n, 1], backward[n, 0]
        if not (taken_a[i] or taken_b[j]):
            pairs[used, 0], pairs[used, 1] = i, j
            used += 1
    return pairs[:used].copy()
