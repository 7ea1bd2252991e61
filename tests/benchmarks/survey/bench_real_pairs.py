"""What the disparities of real stereo pairs say of their calibration: evidence that a scale error is the rig's, not the images'.

`PYTHONPATH=tests python tests/benchmarks/survey/bench_real_pairs.py [NAME...]` prints, for each recording: by which factor and offset
disparities differ
from what several views of the same points say at the truth's scale, measured with windows of several sizes and from right to
left; and how far points of the right picture are off their row, as a function of their place.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.features import stereo
from fleetmap.features.patch_align_kernels import align_patches
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.recordings import open_recording
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import SurveyState, bundle_problem
from mapserver.survey.pipeline import Survey, survey
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs
from support.recordings.realdata import DATA

RECORDINGS = ("euroc_v101_keyframes", "euroc_mh01_start", "kitti_stereo_51")
HALF_WINDOWS_PX = (2, 4, 8)
_LEAST_VIEWS, _LEAST_ANGLE_RAD = 3, 0.06


@dataclass(frozen=True, slots=True)
class Line:
    """measured = (1 + factor) predicted + offset_px, and the spread of what is left; by robust least squares."""

    way: str
    factor: float
    offset_px: float
    spread_px: float
    points: int


@dataclass(frozen=True, slots=True)
class Pairs:
    """Found of one recording. rows_px: right row minus left row is 1, x, y, x y times these, x and y in focal lengths from the middle."""

    name: str
    scale_error: float
    lines: list[Line]
    rows_px: Array


def robust_fit(design: Array, values: Array, rounds: int = 15) -> tuple[Array, float]:
    """Coefficients of a robust linear fit (Huber 1964, with a cut at 5 sigmas) and its spread."""
    weight = np.ones(len(values))
    for _ in range(rounds):
        root = np.sqrt(weight)
        found, *_ = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)
        off = np.abs(values - design @ found)
        spread = 1.4826 * float(np.median(off))
        weight = np.where(off > 5 * spread, 0.0, 1.0 / np.maximum(1.0, off / (1.345 * spread)))
    return np.asarray(found), spread


def examine(name: str) -> Pairs:
    """Surveys a recording and measures its disparities again at the survey's points."""
    with open_recording(DATA / name) as recording:
        rectifier, truth = Rectifier(recording.calibration), recording.ground_truth
        assert truth is not None
        frames = (rectifier.rectify(recording.read_frame(k)) for k in range(len(recording)))
        inputs = SurveyInputs(frames, len(recording), recording.imu, recording.calibration, rectifier)
        done = survey(inputs, SurveyConfig(SurveySettings(), default_vocabulary()))
        scale = absolute_trajectory_error(done.map.trajectory, truth, with_scale=True).scale
        predicted, usable = _predicted(done.state, scale)
        rectified = (
            (k, rectifier.rectify(recording.read_frame(f.frame_index))) for k, f in enumerate(done.odometry.keyframes)
        )
        measured, rows = _measured(done, usable, rectified)
    ways = [*(f"window {2 * half + 1} px" for half in HALF_WINDOWS_PX), "right to left"]
    lines = [_line(way, predicted, measured[:, n]) for n, way in enumerate(ways)]
    design = np.column_stack([np.ones(len(rows)), rows[:, 0], rows[:, 1], rows[:, 0] * rows[:, 1]])
    return Pairs(name, 1 / scale - 1, lines, robust_fit(design, rows[:, 2])[0])


def _predicted(state: SurveyState, scale: float) -> tuple[Array, NDArray[np.int64]]:
    """Disparities (U,) that several views predict at the truth's scale, of the observations (U,) whose points they place well."""
    pixels = state.landmarks.obs_pixels.copy()
    pixels[:, 2] = np.nan
    blind = replace(state, landmarks=replace(state.landmarks, obs_pixels=pixels))
    settings, held = SurveySettings(), np.zeros(len(state.stamps_ns), bool)
    problem = replace(bundle_problem(blind, settings, held), inertial=None, relative=[])
    points = optimize(problem, settings.bundle).points_map
    marks, map_from_cam = state.landmarks, state.map_from_body @ state.body_from_cam
    rays = points[marks.obs_landmark] - map_from_cam[marks.obs_keyframe, :3, 3]
    depth = np.einsum("mi,mi->m", map_from_cam[marks.obs_keyframe, :3, 2], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    first = np.searchsorted(marks.obs_landmark, np.arange(len(points)))
    angle = np.arccos(np.clip(np.einsum("mi,mi->m", rays, rays[first][marks.obs_landmark]), -1, 1))
    widest, views = np.zeros(len(points)), np.bincount(marks.obs_landmark)
    np.maximum.at(widest, marks.obs_landmark, angle)
    good = (widest > _LEAST_ANGLE_RAD) & (views >= _LEAST_VIEWS)
    usable = np.flatnonzero(good[marks.obs_landmark] & np.isfinite(marks.obs_pixels[:, 2]) & (depth > 0.3))
    return state.camera.focal_px * state.camera.baseline_m / (scale * depth[usable]), usable


def _measured(
    done: Survey, usable: NDArray[np.int64], frames: Iterator[tuple[int, RectifiedFrame]]
) -> tuple[Array, Array]:
    """Disparities (U, 4) by each window and from right to left; x, y and row offset (V, 3) of the right picture."""
    marks, camera = done.state.landmarks, done.state.camera
    out, rows = np.full((len(usable), len(HALF_WINDOWS_PX) + 1), np.nan), []
    for k, frame in frames:
        own = np.flatnonzero(marks.obs_keyframe[usable] == k)
        if not len(own):
            continue
        assert frame.right is not None
        left = np.ascontiguousarray(marks.obs_pixels[usable[own], :2])
        before = left[:, 0] - marks.obs_pixels[usable[own], 2]
        for n, half in enumerate(HALF_WINDOWS_PX):
            windows = StereoSettings(wide_half_px=half + 1, narrow_half_px=half, agreement_px=0.5)
            out[own, n] = stereo.disparities(frame, camera, left, windows, before)[:, 0]
        right = np.column_stack([left[:, 0] - before, left[:, 1]])
        same, back, there = np.tile(np.eye(2), (len(own), 1, 1)), np.empty((len(own), 4)), np.empty((len(own), 4))
        align_patches(frame.right, frame.left, right, left, same, 4, 3.0, back)
        out[own, -1] = back[:, 0] - right[:, 0]
        align_patches(frame.left, frame.right, left, right, same, 4, 3.0, there)
        sure = there[:, 3] > 0.9
        place = (left[sure] - [camera.cx_px, camera.cy_px]) / camera.focal_px
        rows.append(np.column_stack([place, there[sure, 1] - left[sure, 1]]))
    return out, np.concatenate(rows)


def _line(way: str, predicted: Array, measured: Array) -> Line:
    known = np.isfinite(measured) & (np.abs(measured - predicted) < 3.0)
    design = np.column_stack([predicted[known], np.ones(known.sum())])
    (factor, offset_px), spread = robust_fit(design, (measured - predicted)[known])
    return Line(way, float(factor), float(offset_px), spread, int(known.sum()))


def show(found: list[Pairs]) -> None:
    """A table for each recording."""
    for pairs in found:
        rows = " ".join(f"{value:+.2f}" for value in pairs.rows_px)
        print(f"{pairs.name}: scale {100 * pairs.scale_error:+.3f} %, rows off by (1, x, y, x y): {rows} px")
        for line in pairs.lines:
            fit = f"factor {100 * line.factor:+.3f} %, offset {line.offset_px:+.4f} px, spread {line.spread_px:.3f} px"
            print(f"    {line.way:14} {fit}, {line.points} points")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *RECORDINGS])
    show([examine(name) for name in parser.parse_args().names or RECORDINGS])


if __name__ == "__main__":
    main()
