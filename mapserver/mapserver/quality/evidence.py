"""What speaks for and against a draft's tiles, measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.failure_definition import ERROR_LIMIT_DEG, ERROR_LIMIT_M
from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse
from fleetmap.sensors.samples import Stamps
from mapserver.quality.figures import Aliasing, Compared, Evidence, Looks, Motion
from mapserver.quality.locate import PRIOR_RADIUS_M, Fix, locate
from mapserver.quality.probes import Probe
from mapserver.quality.tile_map import Lookalikes, TileMap
from mapserver.survey.settings import SurveySettings

_ELSEWHERE_M = 2 * PRIOR_RADIUS_M + 2.0  # a neighbourhood that shares no place with the true one's
_STRETCH_M, _APART_M = 3.0, 1.0
_BREAK_M, _BREAK_SHARE = 0.15, 0.05
_CONTINUOUS_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class Offered:
    """The probes of each kind: held-out frames of the new recordings, frames of older ones, the current version's keyframes."""

    held_out: Sequence[Probe]
    replayed: Sequence[Probe]
    last_version: Sequence[Probe]


def examine(
    draft: TileMap, before: TileMap | None, offered: Offered, motion: Motion | None, vocabulary: Vocabulary,
    settings: SurveySettings,
) -> Evidence:  # fmt: skip
    """What the probes find in the draft, and in the current version's tiles where there are any."""
    look_alike = [*offered.held_out, *offered.replayed] or offered.last_version
    return Evidence(
        compare(draft, before, offered.held_out, settings),
        compare(draft, before, offered.replayed, settings),
        compare(draft, before, offered.last_version, settings),
        aliasing(draft, look_alike, vocabulary, settings),
        None if before is None else aliasing(before, look_alike, vocabulary, settings),
        motion,
    )


def compare(
    draft: TileMap, before: TileMap | None, probes: Sequence[Probe], settings: SurveySettings
) -> Compared | None:
    """Each probe localised in both maps from a prior where it was taken; None without probes."""
    if not probes:
        return None
    now = [locate(draft, probe.look, probe.map_from_cam, settings) for probe in probes]
    if before is None:
        return Compared(_looks(probes, now))
    then = [locate(before, probe.look, probe.map_from_cam, settings) for probe in probes]
    shares = [a.inliers / b.inliers for a, b in zip(now, then, strict=True) if a is not None and b is not None]
    return Compared(_looks(probes, now), _looks(probes, then), round(float(np.median(shares)), 4) if shares else None)


def _looks(probes: Sequence[Probe], fixes: Sequence[Fix | None]) -> Looks:
    found = [(fix, se3_inverse(p.map_from_cam) @ fix.map_from_cam) for p, fix in zip(probes, fixes, strict=True) if fix]
    if not found:
        return Looks(len(probes), 0.0, 0.0, None, None, None, None)
    errors_m = np.array([np.linalg.norm(off[:3, 3]) for _, off in found])
    turns_rad = np.array([rotation_angle_rad(off[:3, :3]) for _, off in found])
    wrong = (errors_m > ERROR_LIMIT_M) | (turns_rad > np.radians(ERROR_LIMIT_DEG))
    return Looks(
        len(probes),
        round(len(found) / len(probes), 4),
        round(float(wrong.mean()), 4),
        round(float(np.median(errors_m)), 5),
        round(float(np.percentile(errors_m, 95)), 5),
        float(np.median([fix.inliers for fix, _ in found])),
        round(float(np.median([fix.residual_px for fix, _ in found])), 4),
    )


def aliasing(
    tile_map: TileMap, probes: Sequence[Probe], vocabulary: Vocabulary, settings: SurveySettings
) -> Aliasing | None:
    """Each probe offered with the prior of the far place that looks most like it; None where there is no such place."""
    lookalikes = Lookalikes(tile_map, vocabulary)
    offered = accepted = 0
    for probe in probes:
        elsewhere = lookalikes.of(probe.look, probe.map_from_cam, _ELSEWHERE_M)
        if elsewhere is not None:
            offered += 1
            accepted += locate(tile_map, probe.look, elsewhere, settings) is not None
    return Aliasing(offered, round(accepted / offered, 4)) if offered else None


def trajectory_breaks(
    stamps_ns: Stamps, map_from_body: Array, odom_from_body: Array, covariances: Array, tracked: NDArray[np.bool_]
) -> Motion | None:
    """Where a survey's trajectory leaves what odometry saw, over stretches of three metres; None where it is shorter.

    Both (F, 4, 4) of the frames at stamps_ns (F,), covariances (F, 6, 6) of odometry, rotation first; stretches with a frame that
    is not tracked (F,), or more than half a second after the one before, are left out: odometry knows little there. A stretch
    differs where its end is off by more than 0.15 m, 5 % of the way and three standard deviations of the odometry together.
    Those that begin within a metre of the one before are one break.
    """
    steps_m = np.linalg.norm(np.diff(odom_from_body[:, :3, 3], axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    follows = tracked & (np.diff(stamps_ns, prepend=stamps_ns[:1]) < _CONTINUOUS_NS)
    lost = np.concatenate([[0], np.cumsum(~follows)])
    starts = np.arange(len(along_m))
    ends = np.searchsorted(along_m, along_m + _STRETCH_M)
    whole = ends < len(along_m)
    starts, ends = starts[whole], ends[whole]
    whole = lost[ends + 1] == lost[starts + 1]
    starts, ends = starts[whole], ends[whole]
    if not len(starts):
        return None
    by_map = se3_inverse(map_from_body[starts]) @ map_from_body[ends]
    by_odometry = se3_inverse(odom_from_body[starts]) @ odom_from_body[ends]
    off_m = np.linalg.norm(by_map[:, :3, 3] - by_odometry[:, :3, 3], axis=1)
    gained = np.trace((covariances[ends] - covariances[starts])[:, 3:, 3:], axis1=1, axis2=2)
    allowed_m = _BREAK_M + _BREAK_SHARE * (along_m[ends] - along_m[starts]) + 3.0 * np.sqrt(np.maximum(gained, 0.0))
    torn = np.flatnonzero(off_m > allowed_m)
    begun_m = along_m[starts[torn]]
    breaks = int(len(torn) > 0) + int((np.diff(begun_m) > _APART_M).sum())
    return Motion(len(starts), breaks, round(float(off_m.max()), 4))
