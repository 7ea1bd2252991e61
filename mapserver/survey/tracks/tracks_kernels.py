"""Joining matched features to tracks by a union-find that never puts one keyframe twice into a group; aligning their patches."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.patch_align_kernels import align_patch
from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

Indices = NDArray[np.int64]
Links = NDArray[np.int32]  # a long survey has ten million
Octaves = NDArray[np.int8]
Picture = NDArray[np.uint8]
_LOG2_SCALE = math.log2(1.2)


@kernel
def _root(parents: Links, node: int) -> int:
    while parents[node] != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


@kernel
def join(first: Links, second: Links, keyframes: Links) -> Links:
    """(V,) the root of each of V nodes after joining first (L,) with second (L,) in their order.

    keyframes (V,): a link that would bring two nodes of one keyframe into one group is left out.
    """
    count = len(keyframes)
    parents, sizes = np.arange(count).astype(np.int32), np.ones(count, np.int32)
    following, last = np.full(count, -1, np.int32), np.arange(count).astype(np.int32)
    marks = np.full(keyframes.max() + 1 if count else 0, -1, np.int32)
    for link in range(len(first)):
        a, b = _root(parents, first[link]), _root(parents, second[link])
        if a == b:
            continue
        if sizes[a] < sizes[b]:
            a, b = b, a
        node = a
        while node >= 0:
            marks[keyframes[node]] = link
            node = following[node]
        node, clash = b, False
        while node >= 0 and not clash:
            clash = marks[keyframes[node]] == link
            node = following[node]
        if clash:
            continue
        parents[b] = a
        sizes[a] += sizes[b]
        following[last[a]] = b
        last[a] = last[b]
    for node in range(count):
        parents[node] = _root(parents, node)
    return parents


@inner_kernel
def _halving(octave: int) -> int:
    """As `patch_align.halvings`."""
    return int(min(max(np.rint(octave * _LOG2_SCALE), 0.0), 2.0))


class PatchFeatures(NamedTuple):
    """Features of a keyframe, those of them that are chosen (N,), and its picture whole, halved and quartered."""

    pyramid: tuple[Picture, Picture, Picture]
    pixels: Array
    octaves: Octaves
    angles_deg: NDArray[np.float32]
    chosen: Indices


@inner_kernel
def _of_level(level: int, pyramid: tuple[Picture, Picture, Picture]) -> Picture:
    return pyramid[0] if level == 0 else (pyramid[1] if level == 1 else pyramid[2])


@kernel
def _warp_of_motion(x: float, y: float, z: float, own_from_reference: Array, warp: Array) -> bool:
    """As `patch_align.similarity_from_motion` for one point of the reference; False where the warp is degenerate."""
    m = own_from_reference
    if not z > 1e-6:
        return False
    seen = np.empty((3, 3))  # the point, and what is a hundredth of its depth to the right and below
    step = 0.01 * z
    for k in range(3):
        px, py = x + (step if k == 1 else 0.0), y + (step if k == 2 else 0.0)
        for a in range(3):
            seen[k, a] = m[a, 0] * px + m[a, 1] * py + m[a, 2] * z + m[a, 3]
        if not seen[k, 2] > 1e-6:
            return False
    for k in range(2):
        for a in range(2):
            warp[a, k] = (seen[k + 1, a] / seen[k + 1, 2] - seen[0, a] / seen[0, 2]) / 0.01
    determinant = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
    if not 0.02 < abs(determinant) < 50.0:
        return False
    a, b, c, d = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    warp[0, 0], warp[0, 1] = d / determinant, -b / determinant
    warp[1, 0], warp[1, 1] = -c / determinant, a / determinant
    return True


@kernel
def align_observations(
    reference: PatchFeatures,
    own: PatchFeatures,
    points_reference: Array,
    own_from_reference: Array,
    limits: tuple[int, float, float],
    out: Array,
) -> None:
    """Refined pixels of one keyframe's chosen features (N,) against those of a reference keyframe.

    points_reference (N, 3) as the reference's camera sees them. The warp comes from the motion own_from_reference (4, 4), which is
    finer than octaves and angles; from those where it is degenerate. limits: half window and largest shift in pixels, least
    correlation. out (N, 3): x, y, sigma_px in level-0 pixels, NaN where the patches do not agree.
    """
    half_window, max_shift_px, min_correlation = limits
    theirs, ours = reference.chosen, own.chosen
    side = 2 * half_window + 1
    template, window = np.empty((side + 2, side + 2)), np.empty((side, side))
    warp, found = np.empty((2, 2)), np.empty(4)
    for n in range(len(theirs)):
        i, j = theirs[n], ours[n]
        x, y, z = points_reference[n, 0], points_reference[n, 1], points_reference[n, 2]
        if not _warp_of_motion(x, y, z, own_from_reference, warp):
            scale = 1.2 ** float(int(reference.octaves[i]) - int(own.octaves[j]))
            angle = math.radians(float(reference.angles_deg[i]) - float(own.angles_deg[j]))
            warp[0, 0] = warp[1, 1] = scale * math.cos(angle)
            warp[1, 0] = scale * math.sin(angle)
            warp[0, 1] = -warp[1, 0]
        level, own_level = _halving(int(reference.octaves[i])), _halving(int(own.octaves[j]))
        size, own_size = 2.0**level, 2.0**own_level
        for a in range(2):
            for b in range(2):
                warp[a, b] *= own_size / size
        image, own_image = _of_level(level, reference.pyramid), _of_level(own_level, own.pyramid)
        x, y = reference.pixels[i, 0] / size, reference.pixels[i, 1] / size
        own_x, own_y = own.pixels[j, 0] / own_size, own.pixels[j, 1] / own_size
        space = template, window, found
        align_patch(image, own_image, x, y, own_x, own_y, warp, half_window, max_shift_px, *space)
        for a in range(3):
            out[n, a] = found[a] * own_size if found[3] >= min_correlation else np.nan
