"""Decides running canaries: promotes proven versions, withdraws versions that are worse than the margin."""

import logging

from fleetmap.errors import FleetmapError
from mapserver import releases
from mapserver.fleet.ingest import arm_key
from mapserver.fleet_statistics.canary_decision import DAY_NS, CanaryFinding, CanarySettings, judge_canary
from mapserver.fleet_statistics.kpis import Counters
from mapserver.store import Actor, CanaryRow, MapStore

ACTOR = "canary"
_log = logging.getLogger(__name__)


def find(store: MapStore, canary: CanaryRow, settings: CanarySettings, now_ns: int) -> CanaryFinding:
    """Return the counts of both arms since the canary began, and the decision."""
    arms = store.fleet.counters_of(canary.site, "arm", 0)
    ours, theirs = (arms.get(arm_key(canary.id, is_canary=is_ours), Counters()) for is_ours in (True, False))
    end_ns = now_ns if canary.ended_ns is None else canary.ended_ns
    return judge_canary(ours, theirs, (end_ns - canary.started_ns) / DAY_NS, settings)


def review(store: MapStore, settings: CanarySettings, now_ns: int) -> list[CanaryFinding]:
    """End every decidable canary and return the findings. One that cannot be ended stays and is logged."""
    done = []
    for canary in store.canaries(running=True):
        finding = find(store, canary, settings, now_ns)
        if finding.action == "wait":
            continue
        try:
            promote = finding.action == "promote"
            releases.end_canary(store, canary, promote=promote, outcome=finding.reason, actor=Actor(ACTOR))
        except FleetmapError as error:
            _log.error("the canary of site %s, version %d, could not be ended: %s", canary.site, canary.version, error)
            continue
        _log.warning("site %s, version %d: %s, because %s", canary.site, canary.version, finding.action, finding.reason)
        done.append(finding)
    return done
