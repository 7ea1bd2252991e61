"""Every frame, every thirtieth, or by overlap: what a keyframe policy costs, and what it loses in a fast turn."""

import time
from functools import partial
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.back_end.bench_site import ate_m
from benchmarks.common.simulated_survey import SimulatedSurvey, drawn_alignment, session_of, simulated_survey
from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.errors import SurveyError
from fleetmap.geometry import Array
from fleetmap.sensors.samples import SensorSet
from mapserver.config import survey_settings
from mapserver.survey.keyframes.keyframes import FrameSummary, KeyframePolicy
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import survey_from
from mapserver.survey.survey_inputs import SurveyConfig
from studies.study import Column, Row, publish, results, table

SEEDS = range(51, 54)
POLICIES: dict[str, dict[str, Any]] = {
    "every frame": {"policy": "every"},
    "every thirtieth": {"policy": "every-nth", "every_nth": 30},
    "by overlap": {"policy": "overlap"},
}
_RATE_HZ, _FRAMES, _HOUR_S = 15.0, 300, 3600


def settings_of(policy: str) -> SurveySettings:
    """The map server's own settings with another choice of keyframes."""
    settings = survey_settings(None, SensorSet.STEREO_INERTIAL)
    chosen = msgspec.structs.replace(settings.keyframes, **POLICIES[policy])
    return msgspec.structs.replace(settings, keyframes=chosen)


def hovering(policy: str) -> int:
    """Keyframes of an hour at one spot."""
    chooser, ids = KeyframePolicy(settings_of(policy).keyframes), np.arange(150)
    still = partial(
        FrameSummary, odom_from_body=np.eye(4), track_ids=ids, scene_depth_m=5.0, sharpness=1.0, after_gap=False
    )
    minute = sum(chooser.wants(still(stamp_ns=int(n * 1e9 / _RATE_HZ))) for n in range(int(60 * _RATE_HZ)))
    return minute * _HOUR_S // 60


def shared_with_next(survey: SimulatedSurvey) -> NDArray[np.int64]:
    """(K - 1,) how many landmarks a keyframe shows that the one before showed too."""
    seen = [np.unique(ids[ids > 0]) for ids in survey.landmarks]
    return np.array([len(np.intersect1d(a, b)) for a, b in pairwise(seen)])


def angles_deg(made: Any) -> Array:
    """(N,) of each landmark, the angle between the first and the last ray that saw it."""
    marks, state = made.state.landmarks, made.state
    centres = (state.map_from_body @ state.body_from_cam)[:, :3, 3]
    first = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map)))
    last = np.append(first[1:], len(marks.obs_landmark)) - 1
    rays = [marks.points_map - centres[marks.obs_keyframe[rows]] for rows in (first, last)]
    a, b = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    return np.asarray(np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0))))


def case(policy: str) -> Row:
    """Medians over the seeds: twenty seconds of a tote robot, 2 m/s and turns on the spot."""
    found: list[dict[str, float]] = []
    settings = settings_of(policy)
    for seed in SEEDS:
        survey = simulated_survey(session_of("small-loop", ["tote-1"], seed, _RATE_HZ, _FRAMES), settings)
        shared = shared_with_next(survey)
        row = {
            "keyframes": len(survey.landmarks),
            "least_shared": int(shared.min()),
            "shared": float(np.median(shared)),
        }
        begin_s = time.process_time()
        try:
            with drawn_alignment(survey):
                made = survey_from(survey.odometry, survey.inputs, SurveyConfig(settings, default_vocabulary()))
        except SurveyError:
            found.append(row)
            continue
        kept = survey.map_from_body[[keyframe.frame_index for keyframe in made.odometry.keyframes]]
        row |= {
            "back_end_s": time.process_time() - begin_s, "observations": len(made.state.landmarks.obs_keyframe),
            "angle_deg": float(np.median(angles_deg(made))), "ate_mm": 1e3 * ate_m(made.state.map_from_body, kept),
            "in_map": len(kept) / len(survey.landmarks),
        }  # fmt: skip
        found.append(row)
    keys = sorted({key for row in found for key in row})
    medians = {key: float(np.median([row[key] for row in found if key in row])) for key in keys}
    return medians | {"hour": hovering(policy), "maps": sum("ate_mm" in row for row in found)}


def draw(rows: list[Row]) -> Figure:
    """What it costs, what a turn leaves, how wide landmarks are seen."""
    figure = Figure(figsize=(10, 2.8), layout="constrained")
    shown = {
        "back_end_s": "back end, CPU s",
        "least_shared": "landmarks across the fastest turn",
        "angle_deg": "median angle, deg",
    }
    for axes, (key, title) in zip(figure.subplots(1, 3), shown.items(), strict=True):
        axes.bar(
            [row["case"] for row in rows], [row.get(key, 0.0) for row in rows], color=("#d1342f", "#c77700", "#14924b")
        )
        axes.set_title(title, fontsize=9)
        axes.tick_params(axis="x", labelsize=8)
    return figure


def main() -> None:
    """Rows, table and picture of docs/studies/keyframe_policies.md."""
    rows = results("keyframe_policies", {policy: partial(case, policy) for policy in POLICIES}, list(SEEDS))
    shown = [
        Column("case", "keyframes"), Column("keyframes", "of 300 frames", "{:.0f}"), Column("back_end_s", "back end, CPU s", "{:.1f}"),
        Column("observations", "observations", "{:.0f}"), Column("angle_deg", "median angle, deg", "{:.1f}"),
        Column("shared", "shared with the one before", "{:.0f}"), Column("least_shared", "least, in a turn", "{:.0f}"),
        Column("in_map", "keyframes in the map", "{:.0%}"), Column("ate_mm", "ATE, mm", "{:.1f}"),
        Column("hour", "keyframes of an hour at one spot"),
    ]  # fmt: skip
    publish("keyframe_policies", [table(rows, shown)], draw(rows))


if __name__ == "__main__":
    main()
