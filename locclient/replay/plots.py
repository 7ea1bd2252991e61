"""Picture of a replay, drawn by OpenCV: path and landmarks, coloured by error; errors and statuses over time."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import UsageError, disk_errors
from fleetmap.failure_definition import ERROR_LIMIT_M, radius_95_m
from fleetmap.geometry import Array
from fleetmap.messages import Status
from locclient.replay.run_metrics import FrameRecord, error_m, frame_ms, localised, localised_share_of_all

Colour = tuple[int, int, int]  # blue, green, red
Picture = NDArray[np.uint8]
_INK, _QUIET, _GRID, _POINT, _ERROR = (36, 31, 27), (128, 114, 107), (235, 231, 229), (161, 149, 139), (235, 99, 37)
_GOOD, _BAD, _NOT_LOCALISED = (75, 146, 20), (47, 52, 209), (168, 60, 190)
_EXACT, _AT_LIMIT = np.array([255, 201, 156]), np.array([92, 31, 11])  # light to dark blue
_STATUS_COLOURS: dict[Status, Colour] = {
    Status.INITIALISING: (200, 190, 180),
    Status.TRACKING: (120, 180, 90),
    Status.DEGRADED: (60, 190, 240),
    Status.AMBIGUOUS: (190, 100, 170),
    Status.LOST: (70, 70, 215),
}
_WIDTH, _PLAN_WIDTH, _TOP, _LEFT, _BELOW = 2040, 1220, 140, 100, 140
_MIN_PLAN_HEIGHT, _MAX_PLAN_HEIGHT = 520.0, 1100.0
_LIMIT_MM = 1e3 * ERROR_LIMIT_M
_MAX_LANDMARKS = 40_000
_STANFORD, _LEVEL_LIMIT_MM = 900, 500.0
_SHIFT = 4  # fractional bits of a coordinate


class RunPlot(NamedTuple):
    """Data of the picture: positions_map_m, truths_map_m (N, 3), NaN if unknown, of N frames; landmarks_map_m (M, 3)."""

    title: str
    frames: Sequence[FrameRecord]
    positions_map_m: Array
    truths_map_m: Array
    landmarks_map_m: Array


def save_picture(picture: Picture, path: Path) -> None:
    """Write a picture as PNG; UsageError if it cannot be written."""
    _, data = cv2.imencode(".png", picture)
    with disk_errors(f"the picture cannot be written to {path}", "check the path", UsageError):
        path.write_bytes(data.tobytes())


def draw_protection(frames: Sequence[FrameRecord]) -> Picture:
    """Return the Stanford diagram (900, 900, 3) BGR of the frames while TRACKING: each one's error and its protection level, which must be
    above it. Levels beyond the axis, and those of frames without a promise, are at its end. Source: Tossaint et al. 2007."""
    picture = np.full((_STANFORD, _STANFORD, 3), 255, np.uint8)
    low, high = (_LEFT, _LEFT), (_STANFORD - 60, _STANFORD - _LEFT)
    axes = _Axes(picture, low, high, np.zeros(2), np.full(2, _LEVEL_LIMIT_MM))
    axes.draw_frame("position error, mm; upwards the protection level, mm")
    axes.line(np.array([[0.0, 0.0], [_LEVEL_LIMIT_MM] * 2]), _BAD, 2)
    known = [f for f in frames if f.error_m is not None and f.status is Status.TRACKING]
    values_mm = 1e3 * np.array([(f.error_m, f.protection_m) for f in known]).reshape(-1, 2)
    bad, none = values_mm[:, 0] > values_mm[:, 1], values_mm[:, 1] >= _LEVEL_LIMIT_MM
    for place, is_bad, is_none in zip(axes.pixels(np.minimum(values_mm, _LEVEL_LIMIT_MM)), bad, none, strict=True):
        axes.dot(place, 2.5, _BAD if is_bad else _NOT_LOCALISED if is_none else _ERROR)
    counts = int((~bad & ~none).sum()), int(none.sum()), int(bad.sum())
    named = zip(("within: {}", "no level: {}", "beyond: {}"), (_ERROR, _NOT_LOCALISED, _BAD), counts, strict=True)
    _legend(picture, (_LEFT, _LEFT - 18), [(words.format(count), colour) for words, colour, count in named])
    return picture


def draw_run(plot: RunPlot) -> Picture:
    """Return the picture (H, 2040, 3) BGR; the height follows the shape of the map."""
    low, high = _view(plot)
    size_m = high - low
    height = float(np.clip(_PLAN_WIDTH * size_m[1] / size_m[0], _MIN_PLAN_HEIGHT, _MAX_PLAN_HEIGHT))
    margin_m = 0.5 * (np.array([_PLAN_WIDTH, height]) / min(_PLAN_WIDTH / size_m[0], height / size_m[1]) - size_m)
    picture = np.full((round(_TOP + height + _BELOW), _WIDTH, 3), 255, np.uint8)
    _text(picture, plot.title, (42, 44), _INK, 0.9)
    _text(picture, _figures(plot), (42, 78), _QUIET, 0.55)
    bottom = round(_TOP + height)
    plan = _Axes(picture, (_LEFT, _TOP), (_LEFT + _PLAN_WIDTH, bottom), low - margin_m, high + margin_m)

    stamps_ns = np.array([frame.stamp_ns for frame in plot.frames], np.int64)
    seconds: Array = np.asarray((stamps_ns - stamps_ns[:1]) * 1e-9)
    values_mm: Array = np.array([np.nan if f.error_m is None else 1e3 * f.error_m for f in plot.frames])
    label = "position error, mm"
    if np.isnan(values_mm).all():
        radii_mm = np.array([1e3 * radius_95_m(frame.cov_rot_trans) for frame in plot.frames])
        values_mm, label = np.where(np.isfinite(radii_mm), radii_mm, np.nan), "95 % radius of the position, mm"
    known_mm = values_mm[~np.isnan(values_mm)]
    ceiling_mm = min(1.1 * float(known_mm.max(initial=0.0)), 2.0 * _LIMIT_MM) or 1.0  # larger values are clipped
    darkest_mm = min(ceiling_mm, _LIMIT_MM)
    _draw_plan(plan, plot, values_mm / darkest_mm, f"{darkest_mm:.0f} mm")

    span_s = max(float(seconds[-1]), 1e-3) if len(seconds) else 1.0
    left, right = _LEFT + _PLAN_WIDTH + 130, _WIDTH - 60
    over_time = _Axes(picture, (left, _TOP), (right, bottom), np.zeros(2), np.array([span_s, ceiling_mm]))
    _draw_over_time(over_time, seconds, values_mm, label)
    strip = _Axes(picture, (left, bottom + 50), (right, bottom + 66), np.zeros(2), np.array([span_s, 1.0]))
    for frame, (begin_s, end_s) in zip(plot.frames, pairwise([*seconds, span_s]), strict=True):
        corners = strip.pixels(np.array([[begin_s, 1.0], [end_s, 0.0]])).round().astype(int)
        cv2.rectangle(picture, corners[0].tolist(), corners[1].tolist(), _STATUS_COLOURS[frame.status], cv2.FILLED)
    met = [status for status in Status if any(frame.status is status for frame in plot.frames)]
    _legend(picture, (left, bottom + 96), [(status.lower(), _STATUS_COLOURS[status]) for status in met])
    return picture


def _view(plot: RunPlot) -> tuple[Array, Array]:
    """Return corners (2,) in metres of a view of the path and most landmarks."""
    path = plot.positions_map_m[~np.isnan(plot.positions_map_m[:, 0]), :2]
    spread = np.percentile(plot.landmarks_map_m[:, :2], [2, 98], axis=0) if len(plot.landmarks_map_m) else path[:2]
    shown = np.vstack([path, spread, [[0.0, 0.0]] if not len(path) and not len(spread) else path[:0]])
    low, high = shown.min(axis=0), shown.max(axis=0)
    edge_m = 0.05 * float((high - low).max()) + 0.3
    return low - edge_m, high + edge_m


def _figures(plot: RunPlot) -> str:
    share, errors, times = localised_share_of_all(plot.frames), error_m(plot.frames), frame_ms(plot.frames)
    figures = [f"{len(plot.frames)} frames"]
    figures += [] if share is None else [f"localized {100 * share:.1f} % of all" if share else "never localized"]
    if errors is not None:
        figures.append(f"error: median {1e3 * errors['median']:.0f} mm, 99 % below {1e3 * errors['p99']:.0f} mm")
    if times is not None:
        figures.append(f"{times['mean']:.1f} ms CPU a frame")
    return "   |   ".join(figures)


def _draw_plan(axes: "_Axes", plot: RunPlot, shares: Array, darkest: str) -> None:
    """Draw the map from above. shares (N,): of the darkest blue."""
    axes.draw_frame("x and y, m")
    landmarks = plot.landmarks_map_m[:: len(plot.landmarks_map_m) // _MAX_LANDMARKS + 1, :2]
    inside = ((landmarks > axes.data_low) & (landmarks < axes.data_high)).all(axis=1)
    for point in axes.pixels(landmarks[inside]):
        axes.dot(point, 1.0, _POINT)
    axes.line(plot.truths_map_m[~np.isnan(plot.truths_map_m[:, 0]), :2], _INK, 1)
    places = axes.pixels(plot.positions_map_m[:, :2])
    good, known = np.array(localised(plot.frames), bool), ~np.isnan(places[:, 0])
    for k in np.flatnonzero(known):
        colour = _by_error(shares[k]) if good[k] else _NOT_LOCALISED
        if k and known[k - 1] and np.linalg.norm(places[k] - places[k - 1]) < 40.0:
            axes.line(plot.positions_map_m[k - 1 : k + 1, :2], colour, 6)
        else:
            axes.dot(places[k], 3.0, colour)
    for point, colour in [*((p, _GOOD) for p in places[known][:1]), *((p, _BAD) for p in places[known][-1:])]:
        axes.dot(point, 8.0, colour)
    entries = [("start", _GOOD), ("end", _BAD), ("landmark", _POINT), ("0 mm", _by_error(0.0))]
    entries += [(darkest, _by_error(1.0)), ("ground truth", _INK), ("not localized", _NOT_LOCALISED)]
    _legend(axes.picture, (axes.low[0], axes.low[1] - 18), entries)


def _draw_over_time(axes: "_Axes", seconds: Array, values_mm: Array, label: str) -> None:
    axes.draw_frame(f"{label}, over seconds since the start")
    ceiling_mm, span_s = float(axes.data_high[1]), float(axes.data_high[0])
    known = np.flatnonzero(~np.isnan(values_mm))
    points = np.column_stack([seconds, np.minimum(values_mm, ceiling_mm)])
    for run in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        axes.line(points[run], _ERROR, 2)
    entries = [("each frame", _ERROR)]
    if len(known):
        median_mm = float(np.median(values_mm[known]))
        axes.line(np.array([[0.0, median_mm], [span_s, median_mm]]), _INK, 1)
        entries.append((f"median {median_mm:.0f} mm", _INK))
    if ceiling_mm > _LIMIT_MM:
        axes.line(np.array([[0.0, _LIMIT_MM], [span_s, _LIMIT_MM]]), _BAD, 1)
        entries.append(("limit of a failure", _BAD))
    _legend(axes.picture, (axes.low[0], axes.low[1] - 18), entries)


def _by_error(share: float) -> Colour:
    """Return light blue at 0 to dark blue at 1; red beyond, grey for NaN."""
    if np.isnan(share) or share > 1.0:
        return _POINT if np.isnan(share) else _BAD
    blue, green, red = _EXACT + max(share, 0.0) * (_AT_LIMIT - _EXACT)
    return int(blue), int(green), int(red)


class _Axes(NamedTuple):
    """A rectangle of the picture from low (top left) to high, in pixels, that shows values from data_low to data_high, each (2,)."""

    picture: Picture
    low: tuple[int, int]
    high: tuple[int, int]
    data_low: Array
    data_high: Array

    def pixels(self, data: Array) -> Array:
        """Return pixels (N, 2) of data points, whose second axis points upwards."""
        share = (data - self.data_low) / (self.data_high - self.data_low)
        share[:, 1] = 1.0 - share[:, 1]
        return np.asarray(self.low + share * np.subtract(self.high, self.low))

    def line(self, data: Array, colour: Colour, width: int) -> None:
        points = np.round(self.pixels(data) * 2**_SHIFT).astype(np.int32)
        cv2.polylines(self.picture, [points], False, colour, width, cv2.LINE_AA, _SHIFT)

    def dot(self, pixel: Array, radius: float, colour: Colour) -> None:
        x, y = np.round(pixel * 2**_SHIFT).astype(int).tolist()
        cv2.circle(self.picture, (x, y), round(radius * 2**_SHIFT), colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def draw_frame(self, label: str) -> None:
        """Draw border, grid, ticks with values, and the label below."""
        cv2.rectangle(self.picture, self.low, self.high, _GRID, 2)
        for axis in (0, 1):
            for value in ticks(float(self.data_low[axis]), float(self.data_high[axis])):
                ends = np.array([self.data_low, self.data_high])
                ends[:, axis] = value
                self.line(ends, _GRID, 1)
                x, y = self.pixels(ends)[0].round().astype(int).tolist()
                _text(self.picture, f"{value:g}", (x - 8, y + 20) if axis == 0 else (x - 50, y + 5), _QUIET)
        _text(self.picture, label, (self.low[0], self.high[1] + 42), _INK)


def ticks(low: float, high: float) -> list[float]:
    """Return about eight round values between two limits, in steps of 1, 2 or 5 times a power of ten."""
    about = 8
    power = 10.0 ** (np.log10((high - low) / about) // 1)
    step = float(next(power * k for k in (1, 2, 5, 10) if power * k * about >= high - low))
    return [round(k * step, 9) for k in range(int(np.ceil(low / step - 1e-9)), int((high / step + 1e-9) // 1) + 1)]


def _text(picture: Picture, words: str, at: tuple[int, int], colour: Colour, scale: float = 0.5) -> None:
    cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)


def _legend(picture: Picture, at: tuple[int, int], entries: Sequence[tuple[str, Colour]]) -> None:
    x, y = at
    for words, colour in entries:
        cv2.rectangle(picture, (x, y - 10), (x + 14, y + 2), colour, cv2.FILLED)
        _text(picture, words, (x + 22, y), _INK)
        x += 46 + 9 * len(words)
