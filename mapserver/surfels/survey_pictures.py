"""Small pictures of the surveys, kept beside a version (an index, and a JPEG for each; docs/map_format.md), and the nearest ones."""

from collections.abc import Callable, Iterable, Sequence
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError, NewerFormatError, StateError
from fleetmap.geometry import Array
from fleetmap.mapformat import Manifest, sha256_hex
from fleetmap.mapformat.manifest import Positive, Sha256
from mapserver.grid.survey_grid import GridSession

PICTURES_KEY = "pictures"
"""Key in `report` of a manifest with the index; older readers ignore it."""

_LARGEST_PX, _QUALITIES, _MOST_BYTES = 320, (75, 50, 25, 5), 20_000
_EVERY_M = 2.0  # of path: at most 10 kB for each metre
_SAME_M, _SAME_COSINE = 1.5, 0.7  # a later picture from there, looking that way, replaces one
_MOST, _FORMAT = 1 << 16, 1
_Triple = Annotated[tuple[float, ...], msgspec.Meta(min_length=3, max_length=3)]


class SurveyPicture(msgspec.Struct, frozen=True, kw_only=True):
    """A picture of a survey: position of its camera and unit vector along its axis in `map`, its stamp, the recording, the JPEG's address.

    stamp_ns: of the recording's clock, which may count from another moment than 1970. kept_ns: of the build that kept it first.
    """

    place_map_m: _Triple
    looks_map: _Triple
    stamp_ns: int
    recording: Annotated[str, msgspec.Meta(max_length=400)]
    sha256: Sha256
    bytes: Positive
    kept_ns: int


class PictureIndex(msgspec.Struct, frozen=True, kw_only=True):
    """The pictures of a version, the latest survey's first."""

    format_version: Positive = _FORMAT
    pictures: Annotated[tuple[SurveyPicture, ...], msgspec.Meta(max_length=_MOST)] = ()


class PicturesReport(msgspec.Struct, frozen=True, kw_only=True):
    """Entry in the report of a build. sha256: of the index; bytes: of it and the pictures; pictures: their number."""

    sha256: Sha256
    bytes: int
    pictures: int


def pictures_of(manifest: Manifest, blob: Callable[[str], bytes]) -> tuple[SurveyPicture, ...]:
    """Return the pictures of a version. StateError with the reason if it has none, MapFormatError or NewerFormatError for invalid bytes."""
    where, found = f"version {manifest.version} of site {manifest.site}", manifest.report.get(PICTURES_KEY)
    if found is None:
        raise StateError(
            f"{where} keeps no pictures of its surveys: it was built without `survey_pictures` in [survey]"
        )
    try:
        index = msgspec.json.decode(blob(msgspec.convert(found, PicturesReport).sha256), type=PictureIndex)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MapFormatError(f"{where}: index of pictures: {error}; it is damaged or of another program") from error
    if index.format_version != _FORMAT:
        raise NewerFormatError(f"{where}: pictures of format {index.format_version}; update this fleetmap")
    return index.pictures


def nearest_pictures(
    pictures: Sequence[SurveyPicture], place_map_m: Array, looks_map: Array | None = None
) -> list[tuple[SurveyPicture, float]]:
    """Return the pictures with their distances in metres, the nearest first, those that look more than 45 degrees elsewhere last."""
    places, axes = (
        np.array([getattr(one, name) for one in pictures]).reshape(-1, 3) for name in ("place_map_m", "looks_map")
    )
    off_m = np.linalg.norm(places - place_map_m, axis=1)
    elsewhere = np.zeros(len(pictures), bool) if looks_map is None else axes @ looks_map < _SAME_COSINE
    return [(pictures[i], float(off_m[i])) for i in np.lexsort([off_m, elsewhere]).tolist()]


def kept_pictures(
    sessions: Iterable[GridSession], before: Sequence[SurveyPicture], blob: Callable[[str], bytes], now_ns: int
) -> tuple[list[bytes], PicturesReport | None]:
    """Return the index and each JPEG, and their report; no bytes and None without pictures.

    before: pictures of the version before, which stay where no later survey looked the same way; blob: their bytes. now_ns: of the build.
    """
    data, found = dict[str, bytes](), list[SurveyPicture]()
    for session in sessions:
        survey, taken, last = session.survey, list[SurveyPicture](), None
        for keyframe in survey.odometry.keyframes:
            map_from_cam = session.map_from_body[keyframe.frame_index] @ survey.state.body_from_cam
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
    others = [one for one in before if not _is_among(one.place_map_m, one.looks_map, found)]
    found = (found + others)[:_MOST]
    if not found:
        return [], None
    addresses = sorted({one.sha256 for one in found})
    index = to_json(PictureIndex(pictures=tuple(found)), order="deterministic")
    blobs = [index, *(data.get(sha256) or blob(sha256) for sha256 in addresses)]
    report = PicturesReport(sha256=sha256_hex(index), bytes=sum(map(len, blobs)), pictures=len(found))
    return blobs, report


def _is_among(place: Sequence[float] | Array, looks: Sequence[float] | Array, taken: Sequence[SurveyPicture]) -> bool:
    """Return True if one of these was taken near the place and looks the same way."""
    places, axes = (
        np.array([getattr(one, name) for one in taken]).reshape(-1, 3) for name in ("place_map_m", "looks_map")
    )
    return bool(((np.linalg.norm(places - place, axis=1) < _SAME_M) & (axes @ looks > _SAME_COSINE)).any())


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    """Return a small JPEG, of lower quality where much is to be seen."""
    scale = min(1.0, _LARGEST_PX / max(picture.shape))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    jpeg = b""
    for quality in _QUALITIES:
        jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(jpeg) <= _MOST_BYTES:
            break
    return jpeg
