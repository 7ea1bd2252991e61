"""Message of a running survey with its key on the bus, and the values exchanged between tracking, the growing map and its viewers."""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import LinkError
from fleetmap.geometry import Array, Indices
from fleetmap.messages import EstimateMessage, Name, Text, Version
from fleetmap.sensors.samples import ImuSamples

MAX_ARRAY_BYTES = 64 << 10
MOST_PLACES = MAX_ARRAY_BYTES // 8  # x and y as float32
NO_PART = 255
COVERAGE_CELL_M = 5.0
_Bytes = Annotated[bytes, msgspec.Meta(max_length=MAX_ARRAY_BYTES)]


class LivePart(msgspec.Struct, frozen=True, kw_only=True):
    """Keyframes with known relative poses, from start_s to end_s of the recording; is_map: it has most of the keyframes."""

    start_s: float
    end_s: float
    keyframes: int
    is_map: bool


class LiveRevisit(msgspec.Struct, frozen=True, kw_only=True):
    """A candidate for a revisit: keyframe at at_s seconds against that at seen_s; its verdict, the reason as text, agreeing matches."""

    at_s: float
    seen_s: float
    verdict: Name
    words: Text
    matches: int


class LiveMissing(msgspec.Struct, frozen=True, kw_only=True):
    """A heading (E along x, N along y of the survey's frame) that no image covers, at a place passed only in the opposite direction."""

    x_m: float
    y_m: float
    heading: Name
    places: int


COLUMNS = {"path_m": 2, "landmarks_m": 2, "loops_m": 4, "cells": 3}
"""Arrays of a survey's map, as little-endian float32."""


class MapSketch(msgspec.Struct, frozen=True, kw_only=True):
    """The growing map after some keyframes; coordinates are metres in its own upright frame.

    path_m (N, 2) and landmarks_m (M, 2), loops_m (L, 4) from and to: thinned evenly. part (N,): bytes, the number in `parts`, NO_PART if
    too little was seen to belong to any. More than one part: tracking was lost, and no certain revisit has joined them yet. loops,
    refused: how many, and of which verdict; revisits: the newest ones. cells (T, 3): x and y of squares of COVERAGE_CELL_M that are
    covered, and their landmarks. estimate: pose of the newest keyframe in this map, with odometry's frame as `odom`.
    """

    keyframes: int
    path_m: _Bytes = b""
    part: _Bytes = b""
    parts: Annotated[list[LivePart], msgspec.Meta(max_length=NO_PART)] = []
    landmarks_m: _Bytes = b""
    loops_m: _Bytes = b""
    loops: int = 0
    refused: Annotated[dict[Name, int], msgspec.Meta(max_length=16)] = {}
    revisits: Annotated[list[LiveRevisit], msgspec.Meta(max_length=32)] = []
    cells: _Bytes = b""
    missing: Annotated[list[LiveMissing], msgspec.Meta(max_length=64)] = []
    estimate: EstimateMessage | None = None

    def rows(self, name: str) -> Array:
        """Return an array of COLUMNS; raises LinkError for invalid bytes."""
        data, columns = getattr(self, name), COLUMNS[name]
        if len(data) % (4 * columns):
            raise LinkError(
                f"{name} of {len(data)} bytes is not an array of {columns} columns; does the sender run the same fleetmap?"
            )
        rows = np.frombuffer(data, "<f4").astype(np.float64).reshape(-1, columns)
        if not np.isfinite(rows).all():
            raise LinkError(f"{name} holds a number that is not finite; check the survey's log")
        return rows

    def part_numbers(self) -> NDArray[np.uint8]:
        """(N,) part numbers along the path, NO_PART if none were sent; raises LinkError for a wrong size or an invalid part number."""
        if not self.part:
            return np.full(len(self.path_m) // 8, NO_PART, np.uint8)
        numbers = np.frombuffer(self.part, np.uint8)
        self._check_length(len(numbers), "part numbers")
        wrong = numbers[(numbers != NO_PART) & (numbers >= len(self.parts))]
        if len(wrong):
            raise LinkError(f"invalid part {wrong[0]} of {len(self.parts)}; does the sender run the same fleetmap?")
        return numbers

    def _check_length(self, count: int, what: str) -> None:
        places = len(self.path_m) // 8
        if places != count:
            raise LinkError(f"a survey of {places} places has {count} {what}; does the sender run the same fleetmap?")


class LiveSurveyState(MapSketch, frozen=True, kw_only=True):
    """State of a running survey at the frame at stamp_ns, with its map, which may lack the newest keyframes.

    phase: `tracking`, `adjusting` while the finished map is made, `stored` as draft `version`, or `failed`, with the reason in `words`.
    seconds: of the recording so far. behind: keyframes waiting for mapping. latency_ms: 99th percentile of the processing time of a
    frame, None unless frames were played in real time; late_frames: those that took longer than the time to the next one.
    quality (N,): bytes along the path, 0 where tracking was lost, 255 where all points agreed. scale_known: False for one camera: the
    growing map has an arbitrary unit, even with an IMU. picture: JPEG of the newest keyframe.
    """

    site: Name
    recording: Text
    stamp_ns: int
    phase: Name
    seconds: float
    frames: int
    behind: int = 0
    latency_ms: float | None = None
    late_frames: int = 0
    quality: _Bytes = b""
    scale_known: bool = True
    picture: _Bytes = b""
    version: Version | None = None
    words: Text = ""

    def path(self) -> Array:
        """(N, 3) x, y and quality from 0 to 1; raises LinkError if their sizes differ."""
        places, quality = self.rows("path_m"), np.frombuffer(self.quality, np.uint8)
        self._check_length(len(quality), "qualities")
        return np.column_stack([places, quality / 255.0])


def thinning(count: int, most: int) -> Indices:
    """Return at most `most` of `count` numbers, evenly, the last one included."""
    step = max(1, -(-count // most))
    return np.arange(count - 1, -1, -step)[::-1].astype(np.int64)


def packed(rows: Array) -> bytes:
    """Return rows as float32 that fit a message, spread evenly; the last one is included."""
    kept = rows[thinning(len(rows), MAX_ARRAY_BYTES // (4 * rows.shape[1]))]
    return kept.astype("<f4").tobytes()


def live_key(site: str) -> str:
    """Key of a site's running survey; '*' for any site."""
    return f"fleetmap/{site}/live/survey"


class NewKeyframe(NamedTuple):
    """A frame chosen by the odometry.

    frame_from_body (4, 4) in odometry's continuous frame; level_from_frame (3, 3) makes that upright by the present gravity estimate.
    step_cov (6, 6): of the motion since the previous keyframe, axes of that one, rotation first; None for the first. motion_body (9,):
    velocity in m/s, gyro and accelerometer bias; imu: samples since the previous keyframe. variance_m2: of the odometry's position,
    summed over the axes.
    """

    number: int
    frame_from_body: Array
    level_from_frame: Array
    step_cov: Array | None
    motion_body: Array
    inertial: bool = False
    imu: ImuSamples = ImuSamples.empty()
    variance_m2: float = 0.0


def joined_imu(parts: Sequence[ImuSamples]) -> ImuSamples:
    """Concatenate samples of consecutive parts."""
    columns = ("stamps_ns", "gyro_radps", "accel_mps2")
    return ImuSamples(*(np.concatenate([getattr(part, column) for part in parts]) for column in columns))
