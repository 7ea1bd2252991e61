"""Replay of a failure: run the present localizer on the robot's percepts, in the robot's map version or in another one.

It starts with the robot's pose and covariance at the beginning of the recording. In the robot's own version it reproduces statuses,
causes, and poses within `SAME_M`; if the recording begins during a search for the pose, only from the first fixes on. Another version
or a newer localizer gets the same percepts; depth of features is known where the robot measured it or its images were kept, and the
odometry, which does not depend on the map, is unchanged.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from math import dist, pi, remainder
from typing import NamedTuple

import numpy as np

from fleetmap.errors import LinkError, UsageError
from fleetmap.failure_definition import BLIND_S, is_blind
from fleetmap.failure_summary import FailureSummary, Moment
from fleetmap.mapformat.manifest import decode_manifest
from fleetmap.mapformat.names import check_sha256
from fleetmap.messages import WantedVersion
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import MountedCamera, MountedRig
from locclient.delivery.failure_file import LocalizerRecord
from locclient.localization.localizer import Localizer
from locclient.maps.loaded_map import LoadedMap
from locclient.maps.map_source import MapSource
from locclient.robot.failure_ring import UsedMap, moment_of

SAME_M, SAME_RAD = 0.01, np.radians(0.5)  # maximum difference of equal poses


class Comparison(NamedTuple):
    """Results then and now, by the same stamps; version: of the map used now."""

    summary: FailureSummary
    version: int | None
    now: list[Moment]

    @property
    def first_difference_ns(self) -> int | None:
        """Return the stamp of the first frame with another status, cause or pose; None if all are equal."""
        pairs = zip(self.summary.moments, self.now, strict=True)
        return next((then.stamp_ns for then, now in pairs if not _is_same(then, now)), None)

    @property
    def apart_m(self) -> float:
        """Return the largest distance between poses of the same frame."""
        pairs = [(a.position_map_m, b.position_map_m) for a, b in zip(self.summary.moments, self.now, strict=True)]
        return max((dist(a, b) for a, b in pairs if a is not None and b is not None), default=0.0)

    @property
    def answer(self) -> str:
        """Return a sentence: would it have failed too?"""
        then_s, now_s = (longest_blind_s(moments) for moments in (self.summary.moments, self.now))
        what = f"version {self.version}" if self.version != self.summary.version else "this client"
        if self.first_difference_ns is None:
            return f"{what} gives the same result for every frame, poses at most {1e3 * self.apart_m:.1f} mm apart"
        verdict = "would not have failed" if then_s > BLIND_S else "gives other results"
        verdict = "would have failed too" if now_s > BLIND_S else verdict
        return f"{what} {verdict}: no reliable position for {now_s:.1f} s now, {then_s:.1f} s then"


def _is_same(then: Moment, now: Moment) -> bool:
    if (then.status, then.cause) != (now.status, now.cause):
        return False
    if then.position_map_m is None or now.position_map_m is None:
        return then.position_map_m is now.position_map_m
    turn_rad = remainder((then.heading_rad or 0.0) - (now.heading_rad or 0.0), 2 * pi)
    return dist(then.position_map_m, now.position_map_m) <= SAME_M and abs(turn_rad) <= SAME_RAD


def longest_blind_s(moments: Sequence[Moment]) -> float:
    """Return the longest time without a reliable position, by `is_blind`, or before the first one."""
    longest_s, since_ns = 0.0, None
    for each in moments:
        radius_m = float("inf") if each.radius_95_m is None else each.radius_95_m
        if not (is_blind(each.status, radius_m) or each.status == "INITIALISING"):
            since_ns = None
            continue
        since_ns = each.stamp_ns if since_ns is None else since_ns
        longest_s = max(longest_s, (each.stamp_ns - since_ns) * 1e-9)
    return longest_s


def phases(moments: Sequence[Moment], began_ns: int) -> Iterator[str]:
    """Yield the successive statuses, each with its time since the failure began."""
    for status, group in groupby(moments, key=lambda each: each.status):
        yield f"{(next(group).stamp_ns - began_ns) * 1e-9:+.1f} s {status}"


def compare_failure(
    failure: tuple[FailureSummary, LocalizerRecord], source: MapSource, manifest_sha256: str | None = None
) -> Comparison:
    """Compare then and now, in the robot's map or in the version with that manifest; LinkError if a tile is not available.

    source: of the site whose map the robot used; a building's other ones are not searched. Of another version,
    tiles within the bounds of those in the robot's memory are used.
    """
    summary, record = failure
    maps: dict[UsedMap, LoadedMap] = {}

    mounted = (MountedCamera(record.camera, record.body_from_cam), *record.others)
    localizer = Localizer(MountedRig(RigCalibration((), None, record.base_from_body), mounted), record.settings)

    def show(used: UsedMap | None) -> None:
        if used is not None:
            if used not in maps:
                maps[used] = _loaded(source, used.floor or summary.site, used, manifest_sha256)
            maps[used].show(localizer, used.floor)

    show(record.used)
    localizer.begin(record.start)
    now = []
    for commands, percept in record.frames:
        show(commands.used)
        if commands.forgets:
            localizer.forget_pose()
        for prior in commands.priors:
            localizer.handle_prior(prior)
        now.append(moment_of(localizer.localize(percept)))
    version = next((loaded.version for loaded in maps.values()), None)
    return Comparison(summary, version, now)


def _loaded(source: MapSource, site: str, used: UsedMap, other_sha256: str | None) -> LoadedMap:
    sha256 = check_sha256(other_sha256 or used.manifest_sha256)
    manifest = decode_manifest(source.blob(sha256))
    if manifest.site != site:
        raise UsageError(f"the manifest {sha256} is of site {manifest.site}, the failure of {site}")
    cells = used.cells
    if sha256 != used.manifest_sha256:
        columns, rows = ({cell[axis] for cell in used.cells} or {0} for axis in (0, 1))
        cells = tuple(
            (tile.x, tile.y)
            for tile in manifest.tiles
            if min(columns) <= tile.x <= max(columns) and min(rows) <= tile.y <= max(rows)
        )
    loaded = source.load(WantedVersion(site=site, version=manifest.version, manifest_sha256=sha256), manifest, cells)
    if missing := [cell for cell in cells if cell not in loaded.tiles]:
        reason = loaded.refused.get(missing[0], "the version does not have it")
        raise LinkError(f"tile {missing[0]} of version {manifest.version} is not available: {reason}")
    return replace(loaded, tiles={cell: loaded.tiles[cell] for cell in cells})
