"""The pictures of the surveys that a build keeps, and those nearest to a place."""

from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.encoding import to_json
from fleetmap.geometry import Array
from fleetmap.mapformat.names import sha256_hex
from fleetmap.recordings.images import jpeg_image
from mapserver.drafting.draft_evidence import MappedSession
from mapserver.store.survey_pictures import MOST, PictureIndex, PicturesReport, SurveyPicture

_LARGEST_PX, _QUALITIES, _MOST_BYTES = 320, (75, 50, 25, 5), 20_000
_EVERY_M = 2.0  # of path: at most 10 kB for each metre
_SAME_M, _SAME_COSINE = 1.5, 0.7  # a later picture from there, looking that way, replaces one


def nearest_pictures(
    pictures: Sequence[SurveyPicture], place_map_m: Array, looks_map: Array | None = None
) -> list[tuple[SurveyPicture, float]]:
    """Return the pictures with their distances in metres, the nearest first, those that look more than 45 degrees elsewhere last."""
    places, axes = _looks(pictures)
    off_m = np.linalg.norm(places - place_map_m, axis=1)
    elsewhere = np.zeros(len(pictures), bool) if looks_map is None else axes @ looks_map < _SAME_COSINE
    return [(pictures[i], float(off_m[i])) for i in np.lexsort([off_m, elsewhere]).tolist()]


def kept_pictures(
    sessions: Iterable[MappedSession], before: Sequence[SurveyPicture], blob: Callable[[str], bytes], now_ns: int
) -> tuple[list[bytes], PicturesReport | None]:
    """Return the index and each JPEG, and their report; no bytes and None without pictures.

    before: pictures of the version before, which stay where no later survey looked the same way; blob: their bytes. now_ns: of the build.
    """
    data, found = dict[str, bytes](), list[SurveyPicture]()
    for session in sessions:
        survey, taken, last = session.survey, list[SurveyPicture](), None
        for keyframe in survey.odometry.keyframes:
            map_from_cam = session.map_from_body[keyframe.frame_index] @ survey.state.rig.body_from_cam[0]
            if last is not None and np.linalg.norm(map_from_cam[:3, 3] - last) < _EVERY_M:
                continue
            place, looks = map_from_cam[:3, 3], map_from_cam[:3, 2]
            if _is_among(place, looks, taken):
                continue
            last, jpeg = place, _jpeg(keyframe.frame.left)
            sha256 = sha256_hex(jpeg)
            data[sha256] = jpeg
            taken.append(
                SurveyPicture(
                    place_map_m=tuple(place.round(3).tolist()), looks_map=tuple(looks.round(4).tolist()),
                    stamp_ns=int(keyframe.frame.stamp_ns), recording=session.name, sha256=sha256, bytes=len(jpeg),
                    kept_ns=now_ns,
                )
            )  # fmt: skip
        found = taken + [one for one in found if not _is_among(one.place_map_m, one.looks_map, taken)]
    found = (found + [one for one in before if not _is_among(one.place_map_m, one.looks_map, found)])[:MOST]
    if not found:
        return [], None
    index = to_json(PictureIndex(pictures=tuple(found)), order="deterministic")
    blobs = [index, *(data.get(sha256) or blob(sha256) for sha256 in sorted({one.sha256 for one in found}))]
    return blobs, PicturesReport(sha256=sha256_hex(index), bytes=sum(map(len, blobs)), pictures=len(found))


def _looks(pictures: Sequence[SurveyPicture]) -> Array:
    """Return (2, K, 3) places and viewing directions."""
    return np.array([(one.place_map_m, one.looks_map) for one in pictures]).reshape(-1, 2, 3).transpose(1, 0, 2)


def _is_among(place: Sequence[float] | Array, looks: Sequence[float] | Array, taken: Sequence[SurveyPicture]) -> bool:
    """Return True if one of these was taken near the place and looks the same way."""
    places, axes = _looks(taken)
    return bool(((np.linalg.norm(places - place, axis=1) < _SAME_M) & (axes @ looks > _SAME_COSINE)).any())


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    """Return a small JPEG, of lower quality where much is to be seen."""
    scale = min(1.0, _LARGEST_PX / max(picture.shape))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return jpeg_image(small, *_QUALITIES, most_bytes=_MOST_BYTES).data
