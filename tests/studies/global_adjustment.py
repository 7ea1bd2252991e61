"""Pose graph alone, and pose graph with global bundle adjustment: what each stage of a survey is worth."""

from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from matplotlib.figure import Figure

from benchmarks.back_end.bench_site import ate_m
from benchmarks.common.simulated_survey import drawn_alignment, session_of, simulated_survey
from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.sensors.samples import ImuSamples, SensorSet
from mapserver.config import survey_settings
from mapserver.survey import stages
from mapserver.survey.state import SurveyState
from mapserver.survey.survey_inputs import AdjustedChain, SurveyConfig
from studies.study import Column, Row, publish, results, table

SEEDS = range(41, 46)
SENSORS = {"stereo alone": SensorSet.STEREO, "stereo, IMU, wheels": SensorSet.STEREO_INERTIAL}
_STAGES = "odometry", "neighbours", "pose graph", "all together"
_BARS = "#d1342f", "#c77700", "#2563eb", "#14924b"


def errors_by_stage(sensors: str, seed: int) -> dict[str, Any]:
    """ATE of the keyframes in metres after each stage of one survey, without pictures; features, tracks and sensors are simulated."""
    settings = survey_settings(None, SENSORS[sensors])
    session = session_of("small-loop", ["survey"], seed)
    if SENSORS[sensors] is SensorSet.STEREO:
        bare = replace(session.session.nominal, imu=None)
        session.session = replace(session.session, nominal=bare, imu=ImuSamples.empty(), wheel=())
    survey = simulated_survey(session, settings)
    seen: list[SurveyState] = []
    close, adjust = stages.close_loops, stages.adjust_globally

    def before_loops(chain: AdjustedChain, *rest: Any) -> Any:
        seen.append(chain.state)
        return close(chain, *rest)

    def after_loops(odometry: Any, state: SurveyState, *rest: Any) -> Any:
        seen.append(state)
        return adjust(odometry, state, *rest)

    hooks = patch.multiple(stages, close_loops=before_loops, adjust_globally=after_loops)
    with drawn_alignment(survey), hooks:
        made = stages.survey_from(survey.odometry, survey.inputs, SurveyConfig(settings, default_vocabulary()))
    numbers = [keyframe.frame_index for keyframe in survey.odometry.keyframes]
    truth = survey.map_from_body[numbers]
    kept = survey.map_from_body[[keyframe.frame_index for keyframe in made.odometry.keyframes]]
    places = [survey.odometry.odom_from_body[numbers], *(state.map_from_body for state in seen)]
    errors_m = [ate_m(place, truth) for place in places] + [ate_m(made.state.map_from_body, kept)]
    return dict(zip(_STAGES, errors_m, strict=True)) | {"loops": len(made.loops.edges)}


def case(sensors: str) -> Row:
    """Medians over the seeds, and the worst."""
    found = [errors_by_stage(sensors, seed) for seed in SEEDS]
    medians = {stage: 1e3 * float(np.median([f[stage] for f in found])) for stage in _STAGES}
    worst = {f"worst {stage}": 1e3 * max(f[stage] for f in found) for stage in _STAGES}
    return {"sensors": sensors, "loops": float(np.median([f["loops"] for f in found])), **medians, **worst}


def draw(rows: list[Row]) -> Figure:
    """Medians by stage, on a logarithmic scale; whiskers reach to the worst seed."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    for axes, row in zip(figure.subplots(1, len(rows), sharey=True), rows, strict=True):
        medians = np.array([row[stage] for stage in _STAGES])
        worst = np.array([row[f"worst {stage}"] for stage in _STAGES])
        axes.bar(_STAGES, medians, yerr=[0 * medians, worst - medians], color=_BARS, capsize=3)
        axes.set_yscale("log")
        axes.set_title(row["sensors"], fontsize=10)
        axes.tick_params(axis="x", labelsize=8)
    figure.axes[0].set_ylabel("ATE of keyframes, mm")
    return figure


def main() -> None:
    """Rows, table and picture of docs/studies/global_adjustment.md."""
    rows = results("global_adjustment", {sensors: partial(case, sensors) for sensors in SENSORS}, list(SEEDS))
    forms = [Column(stage, f"{stage}, mm", "{:.1f}") for stage in _STAGES]
    last = Column("worst all together", "worst seed, mm", "{:.1f}")
    publish(
        "global_adjustment",
        [table(rows, [Column("sensors", "sensors"), Column("loops", "loops", "{:.0f}"), *forms, last])],
        draw(rows),
    )


if __name__ == "__main__":
    main()
