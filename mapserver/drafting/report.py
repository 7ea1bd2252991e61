"""The report of a build. Pure; the keys of `BuildReport` are stable, docs/reports.md lists their meanings."""

import resource
import shlex
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleetmap.encoding import to_plain
from fleetmap.errors import disk_errors
from fleetmap.mapformat.map_errors import ErrorSigmas
from mapserver.drafting.area_corrections import AreaCorrections
from mapserver.drafting.survey_recordings import RecordingSurvey, map_trajectories, taken
from mapserver.evaluation.trajectory_error import Accuracy
from mapserver.quality.directions import one_way_words
from mapserver.quality.figures import Evidence, Starts, SurveyedViews, TileDirections
from mapserver.quality.map_error import error_words
from mapserver.quality.probes import lookalike_words
from mapserver.survey.loops.loops import LoopVerdict
from mapserver.survey.merge.multi_session import MergedMap

MAX_REFUSED = 300  # loops of a build, the most alike first: those could have made a wrong map

_LIBRARIES = ("numpy", "opencv-python-headless", "gtsam", "scipy", "fleetmap")


class BuildReport(msgspec.Struct, frozen=True, kw_only=True):
    """The stable keys, in the order of docs/reports.md. map_bytes is None until the draft is stored."""

    recordings: list[str]
    duration_s: float
    seconds: float
    realtime_factor: float
    path_m: float
    keyframes: int
    landmarks: int
    map_bytes: int | None
    loops: dict[str, int]
    ate_rmse_m: float | None
    ate_sim3_rmse_m: float | None
    evaluated_share: float | None
    scale: str
    scale_error: float | None
    peak_rss_mb: float
    findings: dict[str, list[str]]
    checks: dict[str, str]
    corrections: dict[str, dict[str, float]] = {}
    culled: dict[str, int]
    sessions: list[dict[str, Any]]
    joins: dict[str, str]
    directions: list[TileDirections]
    starts: Starts | None = None
    views: SurveyedViews | None = None
    lookalike_recall: float | None = None
    alias_step_m: float | None = None
    map_errors: dict[str, ErrorSigmas] = {}
    surveyed_requests: dict[str, float] = {}
    removed_landmarks: dict[str, int] = {}


@dataclass(frozen=True)
class BuildResult:
    """The surveys and their outcomes: the map in its final frame, its accuracy, its corrections, and whether it is the site's first."""

    surveyed: list[RecordingSurvey]
    joined: MergedMap
    accuracy: Accuracy
    corrections: AreaCorrections
    is_first: bool

    @property
    def taken(self) -> list[RecordingSurvey]:
        """The recordings that were joined to the map."""
        return taken(self.surveyed, self.joined)


def make_report(built: BuildResult, evidence: Evidence, seconds: float, **more: Any) -> BuildReport:
    """Return the report of a build, map_bytes still unknown. more: keys that the caller knows."""
    joined, recordings, found, mapped = built.joined, built.surveyed, built.accuracy, built.taken
    survey_map = joined.map
    duration_s = sum(float(t.stamps_ns[-1] - t.stamps_ns[0]) * 1e-9 for t in joined.trajectories)
    path_m = sum(float(np.linalg.norm(np.diff(t.positions_m, axis=0), axis=1).sum()) for t in joined.trajectories)
    loops = [s.survey.loops.counts() for s in mapped]
    culled = [asdict(s.survey.culled) for s in mapped]
    return BuildReport(
        recordings=[s.entry.name for s in mapped],
        duration_s=round(duration_s, 6),
        seconds=round(seconds, 3),
        realtime_factor=round(duration_s / max(seconds, 1e-9), 4),
        path_m=round(path_m, 4),
        keyframes=len(survey_map.keyframe_stamps_ns),
        landmarks=len(survey_map.landmark_ids),
        map_bytes=None,
        loops={key: sum(count[key] for count in loops) for key in loops[0]},
        ate_rmse_m=None if found.rigid is None else found.rigid.rmse_m,
        ate_sim3_rmse_m=None if found.similarity is None else found.similarity.rmse_m,
        evaluated_share=found.evaluated_share,
        scale="metric" if survey_map.scale_known else "unknown",
        scale_error=None if found.similarity is None else 1.0 / found.similarity.scale - 1.0,
        peak_rss_mb=round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, 1),
        culled={key: sum(count[key] for count in culled) for key in culled[0]},
        findings={s.entry.name: s.remarks() for s in recordings},
        checks={s.entry.name: s.checks for s in recordings},
        corrections={s.entry.name: s.corrections for s in mapped if s.corrections},
        sessions=[
            {"recording": recordings[o.number].entry.name, "joined": o.joined, "verdict": o.verdict.value}
            | {"reason": o.reason}
            | ({} if o.evidence is None else {"evidence": asdict(o.evidence)})
            | ({} if o.counts is None else asdict(o.counts))
            for o in joined.outcomes
        ],
        joins={s.entry.name: o.verdict.value for s, o in zip(recordings, joined.outcomes, strict=True) if o.joined},
        directions=evidence.directions or [],
        starts=evidence.starts,
        views=evidence.views,
        lookalike_recall=None if evidence.starts is None else evidence.starts.lookalike_recall,
        **more,
    )


def report_details(built: BuildResult, stage_s: dict[str, float]) -> dict[str, Any]:
    """Return keys of the full report beside the stable ones, for diagnosis; they may change.

    loop_records: every candidate, keyframe i against the older j of one recording. stage_s: wall seconds of each stage; reading
    and decoding images are part of odometry. frames_seen_in_map: frames located by points of the map; the others by odometry or the
    IMU. scale_sigma, worst_step: see evaluation/trajectory_error.py. pair_turn, of the first view, and pair_turn_of_views: see
    survey/bundle/stereo_yaw_check.py. parts: the connected components of each survey; the kept one is in the map.
    """
    survey_map, surveyed, found = built.joined.map, built.taken, built.accuracy
    first = surveyed[0]
    return {
        "format": first.format,
        "sensor_set": first.sensor_set.value,
        "inertial": all(s.survey.odometry.inertial for s in surveyed),
        "losses": [{"what": issue.what, "detail": issue.detail} for s in surveyed for issue in s.issues],
        "frames": len(survey_map.trajectory),
        "estimated_frames": int(survey_map.trajectory_estimated.sum()),
        "frames_seen_in_map": sum(int(s.survey.seen.sum()) for s in surveyed),
        "observations": len(survey_map.obs_landmark),
        "point_sigma_median_m": float(np.median(survey_map.point_sigma_m)),
        "ate_max_m": None if found.rigid is None else found.rigid.max_m,
        "sim3_scale": None if found.similarity is None else found.similarity.scale,
        "scale_sigma": found.scale_sigma,
        "worst_step": found.worst_step,
        "pair_turn": [to_plain(s.survey.stereo_yaws[0]) for s in surveyed],
        "pair_turn_of_views": [to_plain(s.survey.stereo_yaws) for s in surveyed],
        "stage_s": {stage: round(seconds, 3) for stage, seconds in stage_s.items()},
        "parts": [to_plain(s.survey.components) for s in surveyed],
        "loop_records": [
            {"recording": s.entry.name} | record for s in surveyed for record in to_plain(s.survey.loops.records)
        ],
    }


def sentence(site: str, version: int, parent: int | None, report: BuildReport, store: Path) -> str:
    """Return text on a draft stored in the folder `store`; parent: the version that it was built on."""
    ate = "" if report.ate_rmse_m is None else f", ATE {report.ate_rmse_m:.4f} m"
    ate += f", {error_words(report.map_errors)}"
    sizes = f"{report.map_bytes} bytes, {report.loops['accepted']} loops{ate}, in {report.seconds:.1f} s"
    built_on = "" if parent is None else f" on version {parent}"
    left = [s["recording"] for s in report.sessions if not s["joined"]]
    left_out = f"; left out, they could not be joined: {', '.join(left)}" if left else ""
    one_way = one_way_words(report.directions)
    blind = "" if report.views is None else report.views.warning
    warned = "".join(f"; {words}" for words in (one_way, lookalike_words(report.starts), blind) if words)
    of = f"of {report.keyframes} keyframes and {report.landmarks} landmarks"
    if report.scale == "unknown":
        return f"site {site}: draft {version} {of}, {sizes}; its scale is unknown, so it can be inspected but not published"
    publish = f"`mapserver publish --site {site} --store {shlex.quote(str(store))}`"
    whole = f"{of} over {report.path_m:.1f} m, {sizes}{left_out}{warned}"
    return f"site {site}: draft {version}{built_on} {whole}; make it current with {publish}"


def loop_places(built: BuildResult) -> list[dict[str, Any]]:
    """Return loops of the recordings in the map: accepted ones and the most similar refused ones.

    Each has its recording, both ends (x, y) in `map`, verdict, reason and score.
    """
    accepted, refused = list[dict[str, Any]](), list[dict[str, Any]]()
    for recording, trajectory in zip(built.taken, map_trajectories(built.joined), strict=True):
        survey = recording.survey
        frames = [keyframe.frame_index for keyframe in survey.odometry.keyframes]
        # Records have keyframe numbers from before components were left out: then their places are unknown.
        for record in survey.loops.records if all(c.kept for c in survey.components) else ():
            ends = [frames[record.i], frames[record.j]]
            start_m, end_m = trajectory.positions_m[ends, :2].round(3).tolist()
            place = {
                "recording": recording.entry.name,
                "from_map_m": start_m,
                "to_map_m": end_m,
                "verdict": record.verdict.value,
                "reason": record.reason,
                "score": round(record.score, 4),
            }
            (accepted if record.verdict is LoopVerdict.ACCEPTED else refused).append(place)
    refused.sort(key=lambda place: (-place["score"], place["recording"], place["from_map_m"], place["to_map_m"]))
    return accepted + refused[:MAX_REFUSED]


def library_versions() -> dict[str, str]:
    """Return versions of the libraries that affect a map."""
    versions = {}
    for name in _LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # not installed, or installed under another name
            versions[name] = "not installed as a package"
    return versions


def write_file(path: Path, data: bytes) -> None:
    """Write a result of a build; StoreError if the disk refuses."""
    with disk_errors(f"{path} cannot be written", "the draft is stored nevertheless"):
        path.write_bytes(data)
