"""Picture of a replay: the path over the map's landmarks, coloured by error, and errors and statuses over time beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import UsageError, disk_errors
from fleetmap.failure_definition import ERROR_LIMIT_M, radius_95_m
from fleetmap.geometry import Array
from fleetmap.messages import Status
from locclient.replay.drawing import INK, QUIET, Canvas, ChartAxes, Colour, draw_legend, ticks
from locclient.replay.run_metrics import FrameRecord, error_m, frame_ms, localised, localised_share_of_all

_WIDTH, _PLAN_WIDTH, _BESIDE_WIDTH = 2040, 1220.0, 640.0
_TOP, _MIN_PLAN_HEIGHT, _MAX_PLAN_HEIGHT = 140.0, 520.0, 1100.0
_POINT, _ERROR, _BAND, _NOT_LOCALISED = (161, 149, 139), (235, 99, 37), (253, 236, 222), (168, 60, 190)
_GOOD, _BAD = (75, 146, 20), (47, 52, 209)
_SCALE = np.array([[255, 201, 156], [235, 99, 37], [92, 31, 11]], float)  # light to dark blue
_LIMIT_MM = 1e3 * ERROR_LIMIT_M
_STATUS_COLOURS: dict[Status, Colour] = {
    Status.INITIALISING: (200, 190, 180),
    Status.TRACKING: (120, 180, 90),
    Status.DEGRADED: (60, 190, 240),
    Status.AMBIGUOUS: (190, 100, 170),
    Status.LOST: (70, 70, 215),
}
_MAX_LANDMARKS = 40_000


@dataclass(frozen=True)
class RunPlot:
    """Values of the picture: positions_map_m, truths_map_m (N, 3), NaN where unknown, of N frames; landmarks_map_m (M, 3)."""

    title: str
    frames: Sequence[FrameRecord]
    positions_map_m: Array
    truths_map_m: Array
    landmarks_map_m: Array

    @property
    def seconds(self) -> Array:
        """(N,) since the first frame."""
        stamps_ns = np.array([frame.stamp_ns for frame in self.frames], np.int64)
        return np.asarray((stamps_ns - stamps_ns[:1]) * 1e-9)

    @property
    def errors_mm(self) -> Array:
        """(N,) distances from the truth; NaN where unknown."""
        return np.array([np.nan if f.error_m is None else 1e3 * f.error_m for f in self.frames])


def save_picture(plot: RunPlot, path: Path) -> None:
    """Writes the picture as PNG; UsageError where it cannot be written."""
    _, data = cv2.imencode(".png", draw_run(plot))
    with disk_errors(f"the picture cannot be written to {path}", "check the path", UsageError):
        path.write_bytes(data.tobytes())


def draw_run(plot: RunPlot) -> NDArray[np.uint8]:
    """(H, 2040, 3) BGR; the height follows the shape of the map."""
    low, high = _view(plot)
    height = float(np.clip(_PLAN_WIDTH * (high - low)[1] / (high - low)[0], _MIN_PLAN_HEIGHT, _MAX_PLAN_HEIGHT))
    grow = np.array([_PLAN_WIDTH, height]) / min(_PLAN_WIDTH / (high - low)[0], height / (high - low)[1]) - (high - low)
    corner = np.array([100.0, _TOP])
    plan = ChartAxes(corner, np.array([corner[0] + _PLAN_WIDTH, _TOP + height]), low - 0.5 * grow, high + 0.5 * grow)
    canvas = Canvas(_WIDTH, round(_TOP + height + 140.0))
    canvas.text(plot.title, np.array([42.0, 44.0]), 21.0, bold=True)
    canvas.text(_figures(plot), np.array([42.0, 78.0]), 12.0, QUIET)
    values, label = (plot.errors_mm, "position error, mm")
    if np.isnan(values).all():
        radii_mm = [1e3 * radius_95_m(frame.cov_rot_trans) for frame in plot.frames]
        values, label = np.where(np.isfinite(radii_mm), radii_mm, np.nan), "95 % radius of the position, mm"
    known = values[~np.isnan(values)]
    # Values beyond the ceiling stand at the upper edge.
    ceiling = min(1.1 * float(known.max(initial=0.0)), 2.0 * _LIMIT_MM) or 1.0
    scale = min(ceiling, _LIMIT_MM)
    _draw_plan(canvas, plan, plot, values / scale)
    _draw_colour_bar(canvas, plan, scale, label)
    _draw_over_time(canvas, plan, plot, values, ceiling, label)
    return canvas.image()


def _view(plot: RunPlot) -> tuple[Array, Array]:
    """Corners (2,) in metres that show the path and most landmarks."""
    path = plot.positions_map_m[~np.isnan(plot.positions_map_m[:, 0]), :2]
    spread = np.percentile(plot.landmarks_map_m[:, :2], [2, 98], axis=0) if len(plot.landmarks_map_m) else path[:2]
    shown = np.vstack([path, spread, [[0.0, 0.0]] if not len(path) and not len(spread) else path[:0]])
    low, high = shown.min(axis=0), shown.max(axis=0)
    edge = 0.05 * float((high - low).max()) + 0.3
    return low - edge, high + edge


def _figures(plot: RunPlot) -> str:
    share, errors, times = localised_share_of_all(plot.frames), error_m(plot.frames), frame_ms(plot.frames)
    figures = [f"{len(plot.frames)} frames in {plot.seconds[-1]:.0f} s" if plot.frames else "no frames"]
    figures += [] if share is None else [f"localised {100 * share:.1f} % of all" if share else "never localised"]
    if errors is not None:
        figures.append(f"error: median {1e3 * errors['median']:.0f} mm, 99 % below {1e3 * errors['p99']:.0f} mm")
    if times is not None:
        figures.append(f"{times['mean']:.1f} ms CPU a frame")
    return "   |   ".join(figures)


def _draw_plan(canvas: Canvas, axes: ChartAxes, plot: RunPlot, shares: Array) -> None:
    axes.draw(canvas, ("x, m", "y, m"))
    landmarks = plot.landmarks_map_m[:: len(plot.landmarks_map_m) // _MAX_LANDMARKS + 1, :2]
    inside = ((landmarks > axes.data_low) & (landmarks < axes.data_high)).all(axis=1)
    radius = float(np.clip(1.6 * (10_000 / max(len(landmarks), 1)) ** 0.5, 0.7, 1.6))
    for point in axes.pixels(landmarks[inside]):
        canvas.dot(point, radius, _POINT)
    truths = plot.truths_map_m[~np.isnan(plot.truths_map_m[:, 0]), :2]
    canvas.line(axes.pixels(truths), INK, 1.5)
    places = axes.pixels(plot.positions_map_m[:, :2])
    good, known = np.array(localised(plot.frames), bool), ~np.isnan(places[:, 0])
    for k in np.flatnonzero(known):
        colour = _colour(shares[k]) if good[k] else _NOT_LOCALISED
        if k and known[k - 1] and np.linalg.norm(places[k] - places[k - 1]) < 40.0:
            canvas.line(places[k - 1 : k + 1], colour, 6.0)
        else:
            canvas.dot(places[k], 3.0, colour)
    for at, colour in ((places[known][:1], _GOOD), (places[known][-1:], _BAD)):
        for point in at:
            canvas.dot(point, 9.0, (255, 255, 255))
            canvas.dot(point, 7.5, colour)
    entries = [("dot", "start", _GOOD), ("dot", "end", _BAD), ("dot", "landmark", _POINT)]
    entries += [("line", "ground truth", INK)] if len(truths) else []
    entries += [("line", "not localised", _NOT_LOCALISED)] if (known & ~good).any() else []
    entries += [("line", f"over {_LIMIT_MM:.0f} mm", _BAD)] if (shares[known & good] > 1.0).any() else []
    draw_legend(canvas, np.array([axes.low[0], axes.low[1] - 18.0]), entries)


def _draw_colour_bar(canvas: Canvas, plan: ChartAxes, ceiling: float, label: str) -> None:
    low = np.array([plan.low[0] + 60.0, plan.high[1] + 66.0])
    bar = ChartAxes(low, np.array([plan.high[0] - 60.0, low[1] + 14.0]), np.zeros(2), np.array([ceiling, 1.0]))
    edges = np.linspace(0.0, ceiling, 201)
    for begin, end in pairwise(edges):
        canvas.box(bar.pixels(np.array([begin, 1.0])), bar.pixels(np.array([end, 0.0])), _colour(begin / ceiling))
    for value in ticks(0.0, ceiling, 10):
        at = np.array([bar.pixels(np.array([value, 0.0]))[0], bar.high[1] + 19.0])
        canvas.text(f"{value:g}", at, colour=QUIET, anchor=0.5)
    canvas.text(label, np.array([0.5 * (bar.low[0] + bar.high[0]), bar.high[1] + 42.0]), colour=QUIET, anchor=0.5)


def _draw_over_time(canvas: Canvas, plan: ChartAxes, plot: RunPlot, values: Array, ceiling: float, label: str) -> None:
    seconds, span_s = plot.seconds, max(float(plot.seconds[-1]), 1e-3) if plot.frames else 1.0
    left, right = plan.high[0] + 130.0, plan.high[0] + _BESIDE_WIDTH + 20.0
    limits = np.array([0.0, 0.0]), np.array([span_s, ceiling])
    axes = ChartAxes(np.array([left, plan.low[1]]), np.array([right, plan.high[1]]), *limits)
    known = np.flatnonzero(~np.isnan(values))
    points = axes.pixels(np.column_stack([seconds, np.minimum(values, ceiling)]))
    pieces = [points[run] for run in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1) if len(run)]
    for piece in pieces:
        foot = [[piece[-1, 0], plan.high[1]], [piece[0, 0], plan.high[1]]]
        canvas.area(np.vstack([piece, foot]), _BAND)
    axes.draw(canvas, ("seconds since the start", label))
    for piece in pieces:
        canvas.line(piece, _ERROR, 1.8)
    entries: list[tuple[str, str, Colour]] = [("line", "each frame", _ERROR)]
    levels = [(float(np.median(values[known])), "median {:.0f} mm", INK)] if len(known) else []
    levels += [(_LIMIT_MM, "limit of a failure", _BAD)] if ceiling > _LIMIT_MM else []
    for level, words, colour in levels:
        canvas.dashes(axes.pixels(np.array([[0.0, level], [span_s, level]])), colour, 1.5)
        entries.append(("dashes", words.format(level), colour))
    draw_legend(canvas, np.array([left, plan.low[1] - 18.0]), entries)
    strip = np.array([left, plan.high[1] + 66.0]), np.array([right, plan.high[1] + 80.0])
    _draw_statuses(canvas, ChartAxes(*strip, *limits), plot)


def _draw_statuses(canvas: Canvas, strip: ChartAxes, plot: RunPlot) -> None:
    """The status of each frame as a coloured piece of a strip along the axis of time."""
    ends_s = np.append(plot.seconds, strip.data_high[0])
    for frame, (begin_s, end_s) in zip(plot.frames, pairwise(ends_s), strict=True):
        corners = strip.pixels(np.array([[begin_s, strip.data_high[1]], [end_s, 0.0]]))
        canvas.box(corners[0], corners[1], _STATUS_COLOURS[frame.status])
    met = [status for status in Status if any(frame.status is status for frame in plot.frames)]
    shown = [("square", status.lower(), _STATUS_COLOURS[status]) for status in met]
    draw_legend(canvas, np.array([strip.low[0], strip.high[1] + 30.0]), shown)


def _colour(share: float) -> Colour:
    """Light blue at 0 to dark blue at 1; red beyond, grey for NaN."""
    if np.isnan(share) or share > 1.0:
        return _POINT if np.isnan(share) else _BAD
    place = float(max(share, 0.0)) * (len(_SCALE) - 1)
    k = min(int(place), len(_SCALE) - 2)
    blue, green, red = _SCALE[k] + (place - k) * (_SCALE[k + 1] - _SCALE[k])
    return int(blue), int(green), int(red)
