"""The archive of a version: the complete survey, for later optimisation. Stays on the server.

Format 2, magic FMAR, in the envelope of `fleetmap.mapformat.container`. The payload: u32 length of a JSON head (the
camera, the next free ids, then name, dtype and shape of every array), the head, and the arrays' bytes in that
order, little-endian.
"""

import struct
from math import prod
from typing import Annotated, Any

import msgspec
import numpy as np

from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import MapFormatError
from fleetmap.geometry import AnyArray
from fleetmap.mapformat.container import pack, unpack
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.survey_map import History, SurveyMap, history_of

ARCHIVE_MAGIC = b"FMAR"
ARCHIVE_FORMAT = 2
MAX_ARCHIVE_PAYLOAD_BYTES = (1 << 32) - 1
# Archives shrink to a third at most: descriptors and pictures hardly repeat. A higher ratio is an attack on memory.
_FREE_BYTES, _MOST_TIMES_SMALLER = 64 << 20, 64
_LEVEL = 3  # written once, rarely read, and large: speed matters more than size
_HEAD_SIZE = struct.Struct("<I")
# Dtype and shape as in the docs of SurveyMap: letters are lengths that arrays share. Patches are square, of any side.
_ARRAYS: dict[str, tuple[str, tuple[int | str, ...]]] = {
    "body_from_cam": ("<f8", (4, 4)),
    "keyframe_stamps_ns": ("<i8", ("K",)),
    "map_from_body": ("<f8", ("K", 4, 4)),
    "landmark_ids": ("<u4", ("N",)),
    "points_map": ("<f8", ("N", 3)),
    "descriptors": ("|u1", ("N", 32)),
    "point_sigma_m": ("<f8", ("N",)),
    "obs_keyframe": ("<i4", ("M",)),
    "obs_landmark": ("<i4", ("M",)),
    "obs_pixels": ("<f8", ("M", 3)),
    "obs_octave": ("|i1", ("M",)),
    "obs_sigma_px": ("<f8", ("M", 2)),
    "patches": ("|u1", ("N", "P", "P")),
    "trajectory_estimated": ("|b1", ("F",)),
    "trajectory_stamps_ns": ("<i8", ("F",)),
    "trajectory_frame_from_body": ("<f8", ("F", 4, 4)),
    "keyframe_ids": ("<u4", ("K",)),
    "is_place": ("|b1", ("K",)),
    "landmark_expected": ("<u4", ("N",)),
    "landmark_seen": ("<u4", ("N",)),
    "landmark_missed": ("<u4", ("N",)),
}
_HISTORY = frozenset(_ARRAYS.keys() & History.__dataclass_fields__.keys())


class _ArrayHead(msgspec.Struct, frozen=True):
    name: str
    dtype: str
    shape: Annotated[tuple[Annotated[int, msgspec.Meta(ge=0, le=1 << 40)], ...], msgspec.Meta(max_length=8)]


class _Head(msgspec.Struct, frozen=True, kw_only=True):
    camera: StereoCamera
    scale_known: bool = True
    next_keyframe_id: int
    next_landmark_id: int
    arrays: tuple[_ArrayHead, ...]


def encode_archive(survey: SurveyMap) -> bytes:
    """Encode the survey without loss."""
    history = history_of(survey)
    values = {name: getattr(history if name in _HISTORY else survey, name, None) for name in _ARRAYS}
    values |= {f"trajectory_{name}": getattr(survey.trajectory, name) for name in ("stamps_ns", "frame_from_body")}
    arrays = {name: np.ascontiguousarray(values[name], dtype) for name, (dtype, _) in _ARRAYS.items()}
    heads = tuple(_ArrayHead(name, _ARRAYS[name][0], array.shape) for name, array in arrays.items())
    ids = {name: getattr(history, name) for name in ("next_keyframe_id", "next_landmark_id")}
    head = to_json(_Head(camera=survey.camera, scale_known=survey.scale_known, **ids, arrays=heads))
    size = _HEAD_SIZE.size + len(head) + sum(array.nbytes for array in arrays.values())
    if size > MAX_ARCHIVE_PAYLOAD_BYTES:
        reason = f"archive of {size} bytes, the limit is {MAX_ARCHIVE_PAYLOAD_BYTES}; survey in several parts"
        raise MapFormatError(reason)
    payload = b"".join([_HEAD_SIZE.pack(len(head)), head, *(array.data for array in arrays.values())])  # copied once
    return pack(ARCHIVE_MAGIC, ARCHIVE_FORMAT, payload, level=_LEVEL)


def decode_archive(data: bytes) -> SurveyMap:
    """Decode the survey from the bytes of `encode_archive`.

    Raises NewerFormatError for a newer format, MapFormatError for an incomplete archive. Memory is proportional to
    the bytes, whatever sizes they state.
    """
    limit = min(MAX_ARCHIVE_PAYLOAD_BYTES, _FREE_BYTES + _MOST_TIMES_SMALLER * len(data))
    payload = unpack(ARCHIVE_MAGIC, ARCHIVE_FORMAT, data, "archive", limit)
    if len(payload) < _HEAD_SIZE.size:
        raise MapFormatError(f"archive: {len(payload)} bytes are too few for its head; the bytes are damaged")
    offset = _HEAD_SIZE.size + int(_HEAD_SIZE.unpack_from(payload)[0])
    head = decode_json(payload[_HEAD_SIZE.size : offset], _Head, "archive: head {}; the bytes are damaged")
    arrays: dict[str, Any] = {}
    for entry in head.arrays:
        if entry.name not in _ARRAYS or _ARRAYS[entry.name][0] != entry.dtype or entry.name in arrays:
            reason = f"archive: array {entry.name!r} of {entry.dtype!r} is unknown; the bytes are damaged"
            raise MapFormatError(reason)
        count = prod(entry.shape)
        end = offset + count * np.dtype(entry.dtype).itemsize
        if end > len(payload):
            raise MapFormatError(f"archive: array {entry.name} of {entry.shape} does not fit in {len(payload)} bytes")
        arrays[entry.name] = np.frombuffer(payload, entry.dtype, count, offset).reshape(entry.shape).copy()
        offset = end
    if offset != len(payload) or len(arrays) != len(_ARRAYS):
        missing = sorted(_ARRAYS.keys() - arrays.keys())
        reason = f"archive: {len(payload) - offset} bytes too many, arrays missing: {missing}; it is damaged"
        raise MapFormatError(reason)
    _check(arrays)
    trajectory = Trajectory(arrays.pop("trajectory_stamps_ns"), arrays.pop("trajectory_frame_from_body"))
    remembered = {name: arrays.pop(name) for name in _HISTORY}
    history = History(next_keyframe_id=head.next_keyframe_id, next_landmark_id=head.next_landmark_id, **remembered)
    return SurveyMap(camera=head.camera, scale_known=head.scale_known, trajectory=trajectory, history=history, **arrays)


def _check(arrays: dict[str, AnyArray]) -> None:
    """Raise MapFormatError for inconsistent arrays: an archive may be untrusted, and builds use it as indices."""
    lengths: dict[int | str, int] = {}
    for name, array in arrays.items():
        shape = _ARRAYS[name][1]
        expected = tuple(
            size if isinstance(size, int) else lengths.setdefault(size, length)
            for size, length in zip(shape, array.shape, strict=False)
        )
        if len(array.shape) != len(shape) or array.shape != expected:
            raise MapFormatError(
                f"archive: {name} has the shape {array.shape}, {expected} fits the others; it is damaged"
            )
    for name, most in (("obs_keyframe", lengths["K"]), ("obs_landmark", lengths["N"]), ("obs_octave", 32)):
        if np.any((arrays[name] < 0) | (arrays[name] >= most)):
            raise MapFormatError(f"archive: {name} is beyond 0 to {most - 1}; it is damaged")
