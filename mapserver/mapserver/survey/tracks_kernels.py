"""Joining matched features to tracks: union-find that never puts one keyframe twice into a group."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.kernel import kernel

Indices = NDArray[np.int64]


@kernel
def _root(parents: Indices, node: int) -> int:
    while parents[node] != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


@kernel
def join(first: Indices, second: Indices, keyframes: Indices) -> Indices:
    """(V,) the root of each of V nodes after joining first (L,) with second (L,) in their order.

    keyframes (V,): a link that would bring two nodes of one keyframe into one group is left out.
    """
    count = len(keyframes)
    parents, sizes = np.arange(count), np.ones(count, np.int64)
    following, last = np.full(count, -1, np.int64), np.arange(count)
    marks = np.full(keyframes.max() + 1 if count else 0, -1, np.int64)
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
