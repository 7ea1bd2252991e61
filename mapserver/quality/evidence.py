"""Evidence for and against a draft's tiles: probes relocalized in them, and the survey's trajectory against odometry."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.failure_definition import ERROR_LIMIT_M, is_wrong
from fleetmap.geometry import Array, Mask, rotation_angle_rad, se3_inverse, transform_points
from fleetmap.relocalization.map_view import MapView, places_around
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.samples import Stamps
from mapserver.quality import probes as probing
from mapserver.quality.figures import Aliasing, Comparison, Displacement, Evidence, ProbeFigures, TrajectoryBreaks
from mapserver.quality.probes import PRIOR_RADIUS_M, SAME_WAY_COSINE, Probe, ProbeFixes
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.merge.session_alignment import count_places
from mapserver.survey.settings import SessionSettings

_STRETCH_M, _APART_M = 3.0, 1.0
_BREAK_M, _BREAK_SHARE = 0.15, 0.05
_CONTINUOUS_NS = 500_000_000
_JOINED = SessionSettings()


@dataclass(frozen=True, slots=True)
class Probes:
    """Held-out frames of the new recordings, frames of older ones, the current version's keyframes."""

    held_out: Sequence[Probe]
    replayed: Sequence[Probe]
    last_version: Sequence[Probe]


def examine(
    draft: MapView,
    before: MapView | None,
    probes: Probes,
    motion: TrajectoryBreaks | None,
    removed_ids: NDArray[np.uint32] | None = None,
    executor: Executor = SERIAL,
) -> Evidence:
    """Return the results of the probes in the draft, and in the current version's tiles if present.

    Robots without a prior are measured with the frames from recordings, with the keyframes if there are none.
    removed_ids: landmarks of the current version that operators' corrections removed from the draft; None for none.
    """
    frames, keyframes = [*probes.held_out, *probes.replayed], probes.last_version
    now = list(executor.map(probing.fixes_of, draft, frames))
    now += executor.map(probing.fixes_with_prior if frames else probing.fixes_of, draft, keyframes)
    then = None if before is None else list(executor.map(probing.fixes_with_prior, before, [*frames, *keyframes]))
    # Those localised in either: a draft cannot lose positions unknown to robots, and with only those of the current version all its
    # chance localisations would count against the draft.
    found = [[fixes[n].near for fixes in (now, then) if fixes is not None] for n in range(len(now))]
    placed = [n for n in range(len(frames), len(now)) if any(fix is not None for fix in found[n])]
    held_out, asked = len(probes.held_out), slice(len(frames) or None)

    def compared(numbers: Sequence[int]) -> Comparison | None:
        return compare(
            draft, before, [now[n] for n in numbers], [then[n] for n in numbers] if then else [], removed_ids
        )

    return Evidence(
        held_out=compared(range(held_out)),
        replayed=compared(range(held_out, len(frames))),
        last_version=compared(placed),
        aliasing=aliasing(now[asked]),
        aliasing_before=None if then is None else aliasing(then[asked]),
        motion=motion,
        starts=probing.starts_without_prior(now[asked]),
        repetition=probing.repetition(now[asked]),
    )


def displaced(
    recording: str, before: MapView, probes: Sequence[tuple[Probe, list[Fix]]], lookalike_recall: float
) -> Displacement:
    """Compare a recording's frames with their fixes anywhere in the version before.

    A frame at a place that looks like another one has a fix there, too. Those count that have none at their own place though that
    version has it, find more of the other than `lookalike_recall`, and agree on it by the motion between them, as many and as far apart as
    those of a joined survey.
    """
    here, placed, found = 0, list[Array](), list[Array]()
    for probe, fixes in probes:
        if any(not is_wrong(float(np.linalg.norm((fix.map_from_cam - probe.map_from_cam)[:3, 3]))) for fix in fixes):
            here += 1
            continue
        if not places_around(before.map_from_cam, probe.map_from_cam, PRIOR_RADIUS_M, SAME_WAY_COSINE).any():
            continue  # it may lie in an aisle that looks the same, and is new
        alike = [fix for fix in fixes if fix.landmark_recall > lookalike_recall]
        placed += [probe.map_from_cam for _ in alike]
        found += [fix.map_from_cam for fix in alike]
    drafted, seen = np.reshape(placed, (-1, 4, 4)), np.reshape(found, (-1, 4, 4))
    moved = [seed @ se3_inverse(own) @ drafted for own, seed in zip(drafted, seen, strict=True)]
    agreeing = [np.linalg.norm((places - seen)[:, :3, 3], axis=1) <= ERROR_LIMIT_M for places in moved]
    best = max(agreeing, key=np.count_nonzero, default=np.zeros(0, bool))
    number = int(best.sum())
    if number < _JOINED.min_fixes or count_places(drafted[best, :3, 3]) < _JOINED.min_places:
        return Displacement(recording, here + number, 0, 0.0)
    off_m = float(np.median(np.linalg.norm((seen - drafted)[best, :3, 3], axis=1)))
    return Displacement(recording, here + number, number, round(off_m, 3))


def compare(
    draft: MapView,
    before: MapView | None,
    now: Sequence[ProbeFixes],
    then: Sequence[ProbeFixes],
    removed_ids: NDArray[np.uint32] | None = None,
) -> Comparison | None:
    """Compare the same probes' fixes in both maps from a prior at their own positions; None without probes.

    Matches of removed landmarks do not count in inliers_share: their loss is wanted, a lost fix is not.
    """
    if not now:
        return None
    if before is None:
        return Comparison(_figures(draft, now))
    left = [0 if each.near is None else _inliers_left(before, each.near, removed_ids) for each in then]
    pairs = zip(now, left, strict=True)
    shares = [each.near.inliers / inliers for each, inliers in pairs if each.near is not None and inliers]
    inliers_share = round(float(np.median(shares)), 4) if shares else None
    return Comparison(_figures(draft, now), _figures(before, then), inliers_share)


def _inliers_left(view: MapView, fix: Fix, removed_ids: NDArray[np.uint32] | None) -> int:
    if removed_ids is None or fix.matches is None:
        return fix.inliers
    return fix.inliers - int(np.isin(view.landmark_ids[fix.matches[:, 1]], removed_ids).sum())


def _figures(view: MapView, probed: Sequence[ProbeFixes]) -> ProbeFigures:
    found = [(each.probe, each.near) for each in probed if each.near is not None]
    if not found:
        return ProbeFigures(len(probed), 0.0, 0.0, None, None, None, None)
    off = np.stack([se3_inverse(probe.map_from_cam) @ fix.map_from_cam for probe, fix in found])
    errors_m = np.linalg.norm(off[:, :3, 3], axis=1)
    wrong = [is_wrong(error_m, rotation_angle_rad(by[:3, :3])) for error_m, by in zip(errors_m, off, strict=True)]
    return ProbeFigures(
        frames=len(probed),
        localised_share=round(len(found) / len(probed), 4),
        wrong_share=round(float(np.mean(wrong)), 4),
        median_error_m=round(float(np.median(errors_m)), 5),
        p95_error_m=round(float(np.percentile(errors_m, 95)), 5),
        median_inliers=float(np.median([fix.inliers for _, fix in found])),
        residual_px=round(float(np.median([_residual_px(view, probe, fix) for probe, fix in found])), 4),
    )


def _residual_px(view: MapView, probe: Probe, fix: Fix) -> float:
    """Return the median distance of a fix's landmarks from their expected pixels."""
    assert fix.matches is not None
    features, rows = fix.matches.T
    expected = probe.camera.pixel_from_point(transform_points(se3_inverse(fix.map_from_cam), view.points_map[rows]))
    return float(np.median(np.linalg.norm(expected[:, :2] - probe.features.pixels[features, :2], axis=1)))


def aliasing(probed: Sequence[ProbeFixes]) -> Aliasing | None:
    """Offer each probe with the prior of the most similar far place; None if there is no such place."""
    accepted = [each.is_misled for each in probed if each.is_misled is not None]
    return Aliasing(len(accepted), round(float(np.mean(accepted)), 4)) if accepted else None


def trajectory_breaks(
    stamps_ns: Stamps, map_from_body: Array, odom_from_body: Array, covariances: Array, tracked: Mask
) -> TrajectoryBreaks | None:
    """Find differences between a survey's trajectory and odometry, over stretches of three metres; None if it is shorter.

    Both (F, 4, 4) of the frames at stamps_ns (F,), covariances (F, 6, 6) of odometry, rotation first; stretches with a frame that
    is not tracked (F,), or more than half a second after the previous one, are left out: odometry is uncertain there. A stretch
    differs if its end is off by more than 0.15 m, 5 % of its length and three standard deviations of the odometry together.
    Those that begin within a metre of the previous one are one break.
    """
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(odom_from_body[:, :3, 3], axis=0), axis=1))])
    follows = tracked & (np.diff(stamps_ns, prepend=stamps_ns[:1]) < _CONTINUOUS_NS)
    lost = np.concatenate([[0], np.cumsum(~follows)])
    ends = np.searchsorted(along_m, along_m + _STRETCH_M)
    starts = np.flatnonzero(ends < len(along_m))
    starts = starts[lost[ends[starts] + 1] == lost[starts + 1]]
    ends = ends[starts]
    if not len(starts):
        return None
    by_map = se3_inverse(map_from_body[starts]) @ map_from_body[ends]
    by_odometry = se3_inverse(odom_from_body[starts]) @ odom_from_body[ends]
    off_m = np.linalg.norm(by_map[:, :3, 3] - by_odometry[:, :3, 3], axis=1)
    gained = np.trace((covariances[ends] - covariances[starts])[:, 3:, 3:], axis1=1, axis2=2)
    allowed_m = _BREAK_M + _BREAK_SHARE * (along_m[ends] - along_m[starts]) + 3.0 * np.sqrt(np.maximum(gained, 0.0))
    torn = np.flatnonzero(off_m > allowed_m)
    breaks = int(len(torn) > 0) + int((np.diff(along_m[starts[torn]]) > _APART_M).sum())
    return TrajectoryBreaks(len(starts), breaks, round(float(off_m.max()), 4))
