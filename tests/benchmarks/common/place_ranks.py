"""How many places of a map would be tried before a right one, if votes were counted for each place or for groups of places."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.looks import EVERY_S
from fleetmap.bow import Vocabulary
from fleetmap.bow.vocabulary import WordIds
from fleetmap.geometry import Array
from fleetmap.numerics.time_sliced import finished
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.relocalization.landmark_visibility import places_around
from fleetmap.relocalization.map_view import MapView
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.replay_source import ReplaySource
from locclient.maps.loaded_map import LoadedMap

_GROUP_M = 3.0  # the relocalizer's own neighbourhood of a place
_LIKE_WAY, _ANY_WAY = 0.5, -1.1  # cosines: of 60 degrees, and below all
_TRIAL_M, _TRIAL_COSINE, _TRIALS = 1.2, 0.8, 2  # so many are tried of places so near to each other
_RIGHT_M, _RIGHT_COSINE = 1.5, 0.71

Groups = NDArray[np.bool_]
GROUPINGS: dict[str, tuple[float, Callable[[Array, Groups], Array]]] = {
    "its own, as robots do": (_LIKE_WAY, lambda shares, _: shares),
    "sum of its group": (_LIKE_WAY, lambda shares, groups: groups @ shares),
    "mean of its group": (_LIKE_WAY, lambda shares, groups: (groups @ shares) / groups.sum(axis=1)),
    "its own times the mean": (_LIKE_WAY, lambda shares, groups: shares * (groups @ shares) / groups.sum(axis=1)),
    "mean, whichever way they look": (_ANY_WAY, lambda shares, groups: (groups @ shares) / groups.sum(axis=1)),
}
"""Score of each place from all places' shares (K,) and groups (K, K), by the cosine up to which a neighbour looks a like way."""
BY_WORDS = "its own, by words"
_UNSEEN_WEIGHT = 5.0  # of words that no place has


def ranks(path: Path, loaded: LoadedMap, frames: str = ":") -> dict[str, list[int | None]]:
    """For each grouping and BY_WORDS: how many places are tried at each look's beginning until a right one is, itself counted, or None.

    Looks that begin where the map has no right place are left out. The map is in the frame of the recording's truth.
    """
    view = MapView(loaded.tiles.values(), loaded.vocabulary, loaded.manifest.camera.focal_px)
    groups = {cosine: _groups(view, cosine) for cosine in (_LIKE_WAY, _ANY_WAY)}
    found: dict[str, list[int | None]] = {name: [] for name in (BY_WORDS, *GROUPINGS)}
    held = [np.unique(loaded.vocabulary.words(view.descriptors[rows])) for rows in view.place_rows]
    with open_recording(path) as recording:
        source = ReplaySource.of(recording, FrameSelection.parse(frames), reverse=False)
        rectifier = Rectifier(source.calibration)
        relocalizer = Relocalizer(view, rectifier.camera, RelocalizerSettings())
        last_s = -np.inf
        for number, stamp_s in enumerate((recording.frame_stamps_ns[source.indices] * 1e-9).tolist()):
            truth = source.truth_map_from_body(number)
            if stamp_s - last_s < EVERY_S - 1e-6 or truth is None:
                continue
            last_s = stamp_s
            is_right = places_around(view.map_from_cam, truth @ rectifier.body_from_cam, _RIGHT_M, _RIGHT_COSINE)
            if not is_right.any():
                continue
            features = finished(relocalizer.extract(rectifier.rectify(source.frame(number))))
            descriptors = features.features.descriptors
            by_words = _word_shares(held, loaded.vocabulary, descriptors)
            found[BY_WORDS].append(_first_right(view.map_from_cam, by_words, is_right))
            shares = view.shown_shares(descriptors)
            for name, (cosine, score) in GROUPINGS.items():
                found[name].append(_first_right(view.map_from_cam, score(shares, groups[cosine]), is_right))
    return found


def _groups(view: MapView, cosine: float) -> Groups:
    return np.stack([places_around(view.map_from_cam, place, _GROUP_M, cosine) for place in view.map_from_cam])


def _word_shares(held: list[WordIds], vocabulary: Vocabulary, descriptors: NDArray[np.uint8]) -> Array:
    """(K,) the share of each place's words that the descriptors have: the score that places had before."""
    is_seen, idf = np.zeros(vocabulary.word_count, bool), vocabulary.idf.astype(np.float64)
    is_seen[vocabulary.words(descriptors)] = True
    return np.array([idf[words[is_seen[words]]].sum() / (idf[words].sum() + _UNSEEN_WEIGHT) for words in held])


def _first_right(map_from_cam: Array, scores: Array, is_right: NDArray[np.bool_]) -> int | None:
    """Number of the first right place among those that are tried, from 1 on."""
    times_around, tried = np.zeros(len(scores), np.int64), 0
    for place in np.argsort(-scores, kind="stable"):
        if times_around[place] >= _TRIALS or scores[place] <= 0.0:
            continue
        tried += 1
        if is_right[place]:
            return tried
        times_around += places_around(map_from_cam, map_from_cam[place], _TRIAL_M, _TRIAL_COSINE)
    return None
