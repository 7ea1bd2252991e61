"""The picture of a replay: top-down path coloured by error over the map's landmarks, and the error over time."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import UsageError
from fleetmap.failure_definition import ERROR_LIMIT_M
from fleetmap.geometry import Array
from locclient.replay.run_metrics import FrameRecord, localised, localised_share

Canvas = NDArray[np.uint8]
_SIZE = (900, 1500)
_PLAN_WIDTH = 900
_INK, _GREY, _PALE = (40, 40, 40), (130, 130, 130), (205, 205, 205)
_FULL_SCALE_M = 0.1


@dataclass(frozen=True)
class RunPlot:
    """Values of the picture: positions_map_m, truths_map_m (N, 3), NaN where unknown, of N frames; landmarks_map_m (M, 3)."""

    title: str
    frames: Sequence[FrameRecord]
    positions_map_m: Array
    truths_map_m: Array
    landmarks_map_m: Array


def save_picture(plot: RunPlot, path: Path) -> None:
    """Writes the picture as PNG; UsageError where it cannot be written."""
    _, data = cv2.imencode(".png", draw_run(plot))
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise UsageError(f"the picture cannot be written to {path} ({error.strerror}); check the path") from error


def draw_run(result: RunPlot) -> Canvas:
    """(900, 1500, 3) BGR."""
    canvas = np.full((*_SIZE, 3), 255, np.uint8)
    _plan(canvas, result)
    _errors(canvas, result)
    return canvas


def _plan(canvas: Canvas, result: RunPlot) -> None:
    points = result.landmarks_map_m
    path = result.positions_map_m[~np.isnan(result.positions_map_m[:, 0])]
    shown = np.vstack([path[:, :2], np.percentile(points[:, :2], [3, 97], axis=0)])
    low, high = shown.min(axis=0) - 1.0, shown.max(axis=0) + 1.0
    scale = min((_PLAN_WIDTH - 80) / (high[0] - low[0]), (_SIZE[0] - 120) / (high[1] - low[1]))

    def pixel(point: Array) -> tuple[int, int]:
        return int(40 + (point[0] - low[0]) * scale), int(_SIZE[0] - 50 - (point[1] - low[1]) * scale)

    for point in points[:: max(1, len(points) // 20000)]:
        x, y = pixel(point)
        if 0 <= x < _PLAN_WIDTH and 60 <= y < _SIZE[0]:
            canvas[y : y + 2, x : x + 2] = (175, 175, 175)
    good = localised(result.frames)
    for k, (position, frame) in enumerate(zip(result.positions_map_m, result.frames, strict=True)):
        if np.isnan(position[0]):
            continue
        colour = _colour(frame.error_m) if good[k] else (200, 120, 200)
        cv2.circle(canvas, pixel(position), 4, colour, -1, cv2.LINE_AA)
        truth = result.truths_map_m[k]
        if not np.isnan(truth[0]):
            cv2.line(canvas, pixel(position), pixel(truth), _INK, 1, cv2.LINE_AA)
    metre = 10.0 ** np.floor(np.log10(0.3 * (high[0] - low[0])))
    cv2.line(canvas, (40, _SIZE[0] - 20), (int(40 + metre * scale), _SIZE[0] - 20), _INK, 3)
    _text(canvas, f"{metre:g} m", (int(50 + metre * scale), _SIZE[0] - 15))
    share = localised_share(result.frames)
    title = f"{result.title}: {len(result.frames)} frames, localised "
    _text(
        canvas,
        title + ("never" if not isinstance(share, float) else f"{100 * share:.1f} % after the first fix"),
        (40, 36),
        0.7,
    )
    _text(canvas, f"green 0 .. red {_FULL_SCALE_M * 1000:.0f} mm of error; violet: not localised", (40, 60))


def _errors(canvas: Canvas, result: RunPlot) -> None:
    left, right, top, bottom = _PLAN_WIDTH + 60, _SIZE[1] - 30, 100, _SIZE[0] - 60
    start = result.frames[0].stamp_ns
    length = max((result.frames[-1].stamp_ns - start) * 1e-9, 1e-3)
    values = [f.error_m for f in result.frames if f.error_m is not None]
    _text(
        canvas,
        "position error, unaligned [mm], over time [s]" if values else "no ground truth in the map's frame",
        (left, 60),
        0.6,
    )
    cv2.rectangle(canvas, (left, top), (right, bottom), _GREY, 1)
    if not values:
        return
    ceiling = max(0.02, min(float(np.percentile(values, 98)) * 1.3, 2 * ERROR_LIMIT_M))
    for share in (0.25, 0.5, 0.75, 1.0):
        y = int(bottom - share * (bottom - top))
        cv2.line(canvas, (left, y), (right, y), _PALE, 1)
        _text(canvas, f"{1000 * share * ceiling:.0f}", (left - 50, y + 5))
    for share in (0.0, 0.5, 1.0):
        _text(canvas, f"{share * length:.0f}", (int(left + share * (right - left)) - 10, bottom + 25))
    good = localised(result.frames)
    for k, frame in enumerate(result.frames):
        if frame.error_m is not None:
            x = int(left + (frame.stamp_ns - start) * 1e-9 / length * (right - left))
            y = int(bottom - min(frame.error_m / ceiling, 1.0) * (bottom - top))
            cv2.circle(canvas, (x, y), 3, _colour(frame.error_m) if good[k] else (200, 120, 200), -1, cv2.LINE_AA)


def _colour(error_m: float | None) -> tuple[int, int, int]:
    """Green without error, through yellow, to red; blue where no truth is known."""
    if error_m is None:
        return 200, 120, 40
    share = min(error_m / _FULL_SCALE_M, 1.0)
    return 40, int(200 * min(1.0, 2 - 2 * share)), int(220 * min(1.0, 2 * share))


def _text(canvas: Canvas, text: str, at: tuple[int, int], size: float = 0.5) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)
