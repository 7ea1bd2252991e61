"""The archive of a version: all of a survey, from which a later one can optimise again. Stays on the server.

Format 2, magic FMAR, in the envelope of `fleetmap.mapformat.container`. The payload: u32 length of a JSON head (the
camera, the next free ids, then name, dtype and shape of every array), the head, and the arrays' bytes one after the
other in that order, little-endian. Format 1 knew no history and one sigma for each observation.
"""

import struct
from dataclasses import asdict
from math import prod
from typing import Annotated, Any

import msgspec
import numpy as np

from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError
from fleetmap.geometry import AnyArray
from fleetmap.mapformat import pack, unpack
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.survey_map import History, SurveyMap, history_of

ARCHIVE_MAGIC = b"FMAR"
ARCHIVE_FORMAT = 2
MAX_ARCHIVE_PAYLOAD_BYTES = (1 << 32) - 1
# Archives shrink to a third at most: corners' descriptors and pictures hardly repeat. What claims more was made to fill a memory.
_FREE_BYTES, _MOST_TIMES_SMALLER = 64 << 20, 64
_LEVEL = 3  # written once, hardly ever read, and large: speed counts more than size
_HEAD_SIZE = struct.Struct("<I")
_DTYPES = {
    "body_from_cam": "<f8",
    "keyframe_stamps_ns": "<i8",
    "map_from_body": "<f8",
    "landmark_ids": "<u4",
    "points_map": "<f8",
    "descriptors": "|u1",
    "point_sigma_m": "<f8",
    "obs_keyframe": "<i4",
    "obs_landmark": "<i4",
    "obs_pixels": "<f8",
    "obs_octave": "|i1",
    "obs_sigma_px": "<f8",
    "trajectory_estimated": "|b1",
    "patches": "|u1",
    "trajectory_stamps_ns": "<i8",
    "trajectory_frame_from_body": "<f8",
}
_HISTORY_DTYPES = {
    "keyframe_ids": "<u4",
    "is_place": "|b1",
    "landmark_expected": "<u4",
    "landmark_seen": "<u4",
    "landmark_missed": "<u4",
}
_ALL_DTYPES = {1: _DTYPES, 2: _DTYPES | _HISTORY_DTYPES}


# Shapes by docs of SurveyMap: letters are lengths that arrays share. Patches are square, of any side.
_SHAPES: dict[str, tuple[int | str, ...]] = {
    "body_from_cam": (4, 4),
    "keyframe_stamps_ns": ("K",),
    "map_from_body": ("K", 4, 4),
    "landmark_ids": ("N",),
    "points_map": ("N", 3),
    "descriptors": ("N", 32),
    "point_sigma_m": ("N",),
    "obs_keyframe": ("M",),
    "obs_landmark": ("M",),
    "obs_pixels": ("M", 3),
    "obs_octave": ("M",),
    "obs_sigma_px": ("M", 2),
    "trajectory_estimated": ("F",),
    "trajectory_stamps_ns": ("F",),
    "trajectory_frame_from_body": ("F", 4, 4),
    "patches": ("N", "P", "P"),
    "keyframe_ids": ("K",),
    "is_place": ("K",),
    "landmark_expected": ("N",),
    "landmark_seen": ("N",),
    "landmark_missed": ("N",),
}


class _ArrayHead(msgspec.Struct, frozen=True):
    name: str
    dtype: str
    shape: Annotated[tuple[Annotated[int, msgspec.Meta(ge=0, le=1 << 40)], ...], msgspec.Meta(max_length=8)]


class _Head(msgspec.Struct, frozen=True):
    camera: StereoCamera
    arrays: tuple[_ArrayHead, ...]
    next_keyframe_id: int = 0
    next_landmark_id: int = 0
    scale_known: bool = True


def encode_archive(survey: SurveyMap) -> bytes:
    """The survey's bytes, without loss."""
    dtypes, history = _ALL_DTYPES[ARCHIVE_FORMAT], history_of(survey)
    arrays = {name: np.ascontiguousarray(values, dtypes[name]) for name, values in _arrays(survey, history).items()}
    head = to_json(
        {
            "camera": asdict(survey.camera),
            "scale_known": survey.scale_known,
            "next_keyframe_id": history.next_keyframe_id,
            "next_landmark_id": history.next_landmark_id,
            "arrays": [{"name": n, "dtype": dtypes[n], "shape": list(a.shape)} for n, a in arrays.items()],
        }
    )
    body = [array.tobytes() for array in arrays.values()]
    size = _HEAD_SIZE.size + len(head) + sum(len(part) for part in body)
    if size > MAX_ARCHIVE_PAYLOAD_BYTES:
        reason = f"archive of {size} bytes, the limit is {MAX_ARCHIVE_PAYLOAD_BYTES}; survey in several parts"
        raise MapFormatError(reason)
    payload = b"".join([_HEAD_SIZE.pack(len(head)), head, *body])
    return pack(ARCHIVE_MAGIC, ARCHIVE_FORMAT, payload, level=_LEVEL)


def decode_archive(data: bytes) -> SurveyMap:
    """The survey of `encode_archive`'s bytes.

    Raises NewerFormatError for a newer format, MapFormatError for bytes that are not a whole archive. Takes memory in proportion to
    the bytes, whatever they claim.
    """
    limit = min(MAX_ARCHIVE_PAYLOAD_BYTES, _FREE_BYTES + _MOST_TIMES_SMALLER * len(data))
    number, payload = unpack(ARCHIVE_MAGIC, ARCHIVE_FORMAT, data, "archive", limit)
    head, offset = _read_head(payload)
    dtypes = _ALL_DTYPES[number]
    arrays: dict[str, AnyArray] = {}
    for entry in head.arrays:
        if dtypes.get(entry.name) != entry.dtype or entry.name in arrays:
            reason = f"archive: array {entry.name!r} of {entry.dtype!r} is none of ours; the bytes are damaged"
            raise MapFormatError(reason)
        count = prod(entry.shape)
        end = offset + count * np.dtype(entry.dtype).itemsize
        if end > len(payload):
            raise MapFormatError(f"archive: array {entry.name} of {entry.shape} does not fit in {len(payload)} bytes")
        arrays[entry.name] = np.frombuffer(payload, entry.dtype, count, offset).reshape(entry.shape).copy()
        offset = end
    if offset != len(payload) or len(arrays) != len(dtypes):
        missing = sorted(set(dtypes) - set(arrays))
        reason = f"archive: {len(payload) - offset} bytes too many, arrays missing: {missing}; it is damaged"
        raise MapFormatError(reason)
    if number == 1:
        arrays["obs_sigma_px"] = np.repeat(arrays["obs_sigma_px"].reshape(-1, 1), 2, axis=1)
    _check(arrays)
    trajectory = Trajectory(arrays.pop("trajectory_stamps_ns"), arrays.pop("trajectory_frame_from_body"))
    fields: dict[str, Any] = {"camera": head.camera, "scale_known": head.scale_known, "trajectory": trajectory}
    fields |= {name: values for name, values in arrays.items() if name not in _HISTORY_DTYPES}
    remembered: dict[str, Any] = {name: values for name, values in arrays.items() if name in _HISTORY_DTYPES}
    if remembered:
        fields["history"] = History(
            **remembered, next_keyframe_id=head.next_keyframe_id, next_landmark_id=head.next_landmark_id
        )
    return SurveyMap(**fields)


def _check(arrays: dict[str, AnyArray]) -> None:
    """Raises MapFormatError for arrays that do not fit each other: an archive may come from elsewhere, and builds index by it."""
    lengths: dict[int | str, int] = {}
    for name, array in arrays.items():
        shape = _SHAPES[name]
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


def _arrays(survey: SurveyMap, history: History) -> dict[str, AnyArray]:
    arrays = {name: getattr(survey, name) for name in _DTYPES if not name.startswith("trajectory_")}
    return arrays | {
        "trajectory_estimated": survey.trajectory_estimated,
        "trajectory_stamps_ns": survey.trajectory.stamps_ns,
        "trajectory_frame_from_body": survey.trajectory.frame_from_body,
        **{name: getattr(history, name) for name in _HISTORY_DTYPES},
    }


def _read_head(payload: bytes) -> tuple[_Head, int]:
    if len(payload) < _HEAD_SIZE.size:
        raise MapFormatError(f"archive: {len(payload)} bytes are too few for its head; the bytes are damaged")
    end = _HEAD_SIZE.size + int(_HEAD_SIZE.unpack_from(payload)[0])
    try:
        return msgspec.json.decode(payload[_HEAD_SIZE.size : end], type=_Head), end
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MapFormatError(f"archive: head {error}; the bytes are damaged") from error
