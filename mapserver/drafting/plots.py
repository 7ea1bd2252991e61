"""Pictures of a survey: from above, and its errors over time."""

import io
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from fleetmap.geometry import Array
from mapserver.drafting.report import BuildReport
from mapserver.evaluation.trajectory_error import Accuracy
from mapserver.survey.loops.loops import Loops, LoopVerdict
from mapserver.survey.survey_map import SurveyMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_LANDMARKS = 40_000
_MAX_REFUSED = 40
_INK, _QUIET, _GRID, _POINT = "#1b1f24", "#6b7280", "#e5e7eb", "#8b95a1"
_GOOD, _BAD, _GUESS, _ERROR = "#14924b", "#d1342f", "#c77700", "#2563eb"
_TIME = LinearSegmentedColormap.from_list("time", ["#9cc9ff", "#2563eb", "#0b1f5c"])
_MIN_ASPECT, _MAX_ASPECT = 0.7, 2.2
_DPI = 150
# The two horizontal axes of the map, right and up on the page, by the axis and sign of the vertical one.
_FLAT_AXES = {(2, 1): (0, 1), (2, -1): (1, 0), (1, 1): (2, 0), (1, -1): (0, 2), (0, 1): (1, 2), (0, -1): (2, 1)}


def draw_survey(title: str, survey_map: SurveyMap, loops: Loops, found: Accuracy, report: BuildReport) -> bytes:
    """Return a PNG: the map from above and, with ground truth, position errors over time beside it."""
    with mpl.rc_context({"font.size": 9, "axes.edgecolor": _GRID, "axes.labelcolor": _INK, "text.color": _INK}):
        # By the axis of the map that points up in most images, also without an IMU
        up_map = -(survey_map.map_from_body @ survey_map.body_from_cam)[:, :3, 1].mean(axis=0)
        axis = int(np.argmax(np.abs(up_map)))
        flat = list(_FLAT_AXES[axis, 1 if up_map[axis] > 0 else -1])
        landmarks = survey_map.points_map[:: len(survey_map.points_map) // _MAX_LANDMARKS + 1, flat]
        low, high = _view(survey_map.trajectory.positions_m[:, flat], landmarks)
        width, height = high - low
        map_height_in = 6.2 if width / height < 1.3 else 8.0 * height / width
        map_width_in = map_height_in * width / height
        beside_in = 1.0 if found.rigid is None else 5.6
        figure = Figure((max(map_width_in + beside_in, 7.0), max(map_height_in, 3.6) + 1.9), layout="constrained")
        if found.rigid is None:
            above = figure.subplots()
        else:
            above, beside = figure.subplots(1, 2, width_ratios=(map_width_in + 0.6, 4.8))
            _draw_errors(beside, found, int(survey_map.trajectory.stamps_ns[0]))
        _draw_map(above, survey_map, flat, landmarks, loops)
        above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        _write_titles(figure, title, report)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def _view(path: Array, landmarks: Array) -> tuple[Array, Array]:
    """Return corners (2,) that contain the path and most landmarks, with a limited aspect ratio."""
    low, high = path.min(axis=0), path.max(axis=0)
    if len(landmarks):  # without a few distant ones, which would shrink the rest
        reach_m = 8.0 + 0.25 * float(max(high - low))
        low = np.maximum(np.minimum(low, np.percentile(landmarks, 3, axis=0)), low - reach_m)
        high = np.minimum(np.maximum(high, np.percentile(landmarks, 97, axis=0)), high + reach_m)
    size = (high - low) + 0.1 * float(max(high - low)) + 0.2
    wanted = np.maximum(size, [_MIN_ASPECT * size[1], size[0] / _MAX_ASPECT])
    middle = 0.5 * (low + high)
    return middle - 0.5 * wanted, middle + 0.5 * wanted


def _draw_map(axes: "Axes", survey_map: SurveyMap, flat: list[int], landmarks: Array, loops: Loops) -> None:
    def dots(points: Array, **look: Any) -> None:
        axes.scatter(points[:, 0], points[:, 1], **look)

    path, places = survey_map.trajectory.positions_m[:, flat], survey_map.map_from_body[:, flat, 3]
    guessed = path[~survey_map.trajectory_estimated]
    size = float(np.clip(20_000 / max(len(landmarks), 1), 0.8, 4.0))
    dots(landmarks, s=size, c=_POINT, alpha=0.55, linewidths=0, zorder=1)
    accepted = [r for r in loops.records if r.verdict is LoopVerdict.ACCEPTED]
    refused = [r for r in loops.records if r.verdict is not LoopVerdict.ACCEPTED]
    refused.sort(key=lambda r: (-r.score, r.i, r.j))
    for records, colour, width, alpha, order, label in (
        (refused[:_MAX_REFUSED], _BAD, 0.5, 0.35, 2, "loop refused"),
        (accepted, _GOOD, 1.1, 0.75, 3, "loop accepted"),
    ):
        if records:
            ends = [places[[r.i, r.j]] for r in records]
            lines = LineCollection(ends, colors=colour, linewidths=width, alpha=alpha, zorder=order, label=label)
            axes.add_collection(lines)
    stamps_ns = survey_map.trajectory.stamps_ns
    pieces = LineCollection(list(np.stack([path[:-1], path[1:]], axis=1)), cmap=_TIME, linewidths=2.4, zorder=4)
    pieces.set_array((stamps_ns[:-1] - stamps_ns[0]) * 1e-9)
    axes.add_collection(pieces)
    dots(places, s=10, c="white", edgecolors=_INK, linewidths=0.6, zorder=5, label="keyframe")
    if len(guessed):
        dots(guessed, s=16, marker="x", c=_GUESS, linewidths=1, zorder=5, label="only guessed")
    for points, marker, colour, label in ((path[:1], "o", _GOOD, "start"), (path[-1:], "s", _BAD, "end")):
        dots(points, s=55, marker=marker, c=colour, edgecolors="white", linewidths=1, zorder=6, label=label)
    axes.set(xlabel=f"{'xyz'[flat[0]]}, m", ylabel=f"{'xyz'[flat[1]]}, m")
    axes.set_aspect("equal", adjustable="box")
    _tidy(axes, columns=6)
    bar = axes.figure.colorbar(pieces, ax=axes, location="bottom", fraction=0.025, pad=0.02, aspect=60)
    bar.set_label("seconds since the start", color=_QUIET)
    bar.ax.spines[:].set_visible(False)


def _draw_errors(axes: "Axes", found: Accuracy, start_ns: int) -> None:
    assert found.rigid is not None
    seconds, errors_cm = (found.rigid.stamps_ns - start_ns) * 1e-9, found.rigid.errors_m * 100
    axes.fill_between(seconds, errors_cm, color=_ERROR, alpha=0.12, linewidth=0)
    marker = "o" if len(seconds) <= 150 else ""
    axes.plot(seconds, errors_cm, color=_ERROR, linewidth=1.3, marker=marker, markersize=2.5, label="each frame")
    axes.axhline(found.rigid.rmse_m * 100, color=_INK, linewidth=1, linestyle=(0, (4, 3)), label="root mean square")
    span = max(float(seconds[-1] - seconds[0]), 1e-3)
    axes.set(xlim=(seconds[0] - 0.01 * span, seconds[-1] + 0.01 * span), ylim=(0, 1.1 * float(errors_cm.max()) + 1e-6))
    axes.set(xlabel="seconds since the start", ylabel="position error after rigid alignment, cm")
    axes.spines[["top", "right"]].set_visible(False)
    _tidy(axes, columns=2)


def _tidy(axes: "Axes", *, columns: int) -> None:
    axes.tick_params(colors=_QUIET, length=0)
    axes.grid(color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, frameon=False, fontsize=8, borderaxespad=0.2)


def _write_titles(figure: Figure, title: str, report: BuildReport) -> None:
    loops = report.loops
    numbers = [
        f"{', '.join(report.recordings)}: {report.path_m:.1f} m in {report.duration_s:.0f} s",
        f"{report.keyframes} keyframes, {report.landmarks:,} landmarks",
        f"{loops['accepted']} of {loops['candidates']} loops accepted",
    ]
    if report.map_bytes is not None:
        numbers.append(f"{report.map_bytes / 1e6:.2f} MB for a robot")
    if report.ate_rmse_m is not None:
        numbers.append(f"ATE {report.ate_rmse_m * 100:.1f} cm")
    height_in = figure.get_figheight()
    # An empty title of three lines keeps room above the axes; both lines are placed by hand, flush left.
    figure.suptitle("\n\n", fontsize=11)
    figure.text(0.02, 1 - 0.14 / height_in, title, fontsize=14, fontweight="bold", va="top")
    figure.text(0.02, 1 - 0.42 / height_in, "  ·  ".join(numbers), fontsize=9, color=_QUIET, va="top")
