"""Releases of an open store: each is decided by `rules` in the transaction that writes it, and is on the disk when it returns."""

from collections.abc import Callable
from dataclasses import replace

import msgspec

from fleetmap.encoding import to_plain
from fleetmap.errors import StateError, UsageError
from fleetmap.mapformat import decode_manifest, decode_tile
from mapserver.fleet_statistics.canary_decision import threshold_for
from mapserver.floor_plan.survey_requests import COVERED_SHARE, IN_USE, KIND
from mapserver.quality.figures import TRUSTED_KEY, TrustedCalibration, trusted_calibrations
from mapserver.quality.gate import GateSettings, GateVerdict, judge
from mapserver.releases import rules
from mapserver.releases.version_diff import Difference, manifest_difference
from mapserver.store import NOBODY, Actor, CanaryRow, MapStore, NewCanary, VerdictRow, VersionInfo
from mapserver.store.rows import LogEntry, ReleaseChanges, SiteReleases
from mapserver.trust.signing import try_update_lists

_USUAL_GATE = GateSettings()
SURVEYED = "surveyed_requests"
"""Key of a build's report with the share of each request covered by its recordings."""

_RECENT_NS = 2 * 86_400_000_000_000  # robots silent for longer are not chosen for canaries


def publish(
    store: MapStore,
    site: str,
    version: int | None = None,
    *,
    actor: Actor = NOBODY,
    force: bool = False,
    gate: GateSettings = _USUAL_GATE,
) -> int:
    """Take a draft (by default the newest one) through the gate, make it current and return its number.

    force: the gate's reasons are logged with the actor, and only its hard limits refuse.

    Raises UsageError for an unknown draft, GateRefusedError for a refused one (its reasons are stored with
    it), StoreError or MapFormatError for one with missing bytes.
    """
    draft = rules.chosen_draft(store.releases(site), version)
    if force and not (actor.name and actor.reason):
        raise UsageError("publishing by force needs an actor and a reason; add --reason")
    judged_against = _pass_gate(store, draft, actor, gate, force=force)
    _change(store, site, lambda rows: rules.publication(rows, draft.version, judged_against, actor))
    return draft.version


def trust_calibration(store: MapStore, draft: VersionInfo, actor: Actor) -> VersionInfo:
    """Return the draft with an operator's confirmation of its calibrations in its manifest.

    It stays a draft for the gate to judge. The confirmation names calibrations by their fingerprint: versions built on this one
    inherit it, other calibrations do not. No change if recordings judged all of them, or they are already trusted.

    Raises UsageError without a name and a reason, StateError for a version that is not a draft, StoreError on a disk error.
    """
    if not (actor.name and actor.reason):
        raise UsageError("trusting a calibration needs an actor and a reason; add --reason")
    manifest, evidence = decode_manifest(store.blob(draft.manifest_sha256)), store.evidence(draft.site, draft.version)
    known = trusted_calibrations(manifest)
    new = [
        TrustedCalibration(rig.rig, sorted(rig.unknown()), actor.name, actor.reason)
        for rig in (evidence.calibrations if evidence else None) or ()
        if rig.unknown() and rig.rig not in {choice.rig for choice in known}
    ]
    if not new:
        return draft
    words = {TRUSTED_KEY: to_plain([*known, *new])}
    changed = msgspec.structs.replace(manifest, configuration=manifest.configuration | words)
    detail = "; ".join(f"calibration {choice.rig}, {', '.join(choice.subjects)} not judged" for choice in new)
    return store.replace_manifest(draft, changed, LogEntry("calibration trusted", detail, draft.version, actor))


def judge_draft(store: MapStore, draft: VersionInfo, gate: GateSettings) -> GateVerdict:
    """Return the gate's verdict on a draft, compared with the site's current version."""
    current = store.current(draft.site)
    return judge(
        store.manifest(draft.site, draft.version),
        None if current is None else store.manifest(draft.site, current.version),
        gate,
        store.evidence(draft.site, draft.version),
    )


def promote(store: MapStore, site: str, version: int, *, actor: Actor = NOBODY) -> None:
    """Make an earlier published version current.

    Raises UsageError for an unknown version, StateError for a draft, StoreError or MapFormatError for one with missing bytes.
    """
    store.check_bytes(store.version(site, version))
    _change(store, site, lambda rows: rules.promotion(rows, version, actor))


def roll_back(
    store: MapStore, site: str, *, to: int | None = None, canary: int | None = None, actor: Actor = NOBODY
) -> int:
    """Make the previous current version current again and return its number; the present one retires.

    During a canary that version is withdrawn instead, and the current one stays. to: the expected version to become current; canary:
    the canary to be ended, by its `id`; None: any.

    Raises StateError without a previous current version or if it differs from the expected one, StoreError or MapFormatError if its
    bytes are incomplete.
    """
    rows = store.releases(site)
    if canary is not None and (rows.canary is None or rows.canary.id != canary):
        raise StateError(f"trial {canary} of site {site} has ended already; check `versions`")
    if rows.canary is not None and to is None:
        outcome = f"taken back by hand: {actor.reason or 'no reason given'}"
        tried = rows.canary
        _change(store, site, lambda rows: rules.canary_withdrawal(rows, tried, outcome, actor, by_hand=True))
        return tried.base_version
    if rows.rollback_target is not None:
        store.check_bytes(rows.versions[rows.rollback_target])
    changes = _change(store, site, lambda rows: rules.rollback(rows, actor, to))
    return next(version for version, state in changes.states if state == "current")


def start_canary(
    store: MapStore, site: str, version: int, share: float, *, actor: Actor = NOBODY, gate: GateSettings = _USUAL_GATE
) -> CanaryRow:
    """Let a share of the site's robots run a version before the others; a draft goes through the gate first.

    Raises the errors of `rules.check_canary`, and those of `publish` for drafts.
    """
    rows = store.releases(site)
    base = rules.check_canary(rows, version, share).version
    wanted = rows.versions[version]
    if wanted.state == "draft":
        _pass_gate(store, wanted, actor, gate, force=False)
    else:
        store.check_bytes(wanted)
    recent_ns = store.now_ns() - _RECENT_NS
    robots = [robot.robot for robot in store.robots(site) if robot.last_seen_ns >= recent_ns]
    new = NewCanary(version, base, share, threshold_for(share, site, version, robots), actor)
    _change(store, site, lambda rows: rules.canary_start(rows, new))
    return store.canaries(site, running=True)[0]


def end_canary(store: MapStore, canary: CanaryRow, *, promote: bool, outcome: str, actor: Actor = NOBODY) -> None:
    """Make the canary's version current, or withdraw it from its robots and retire it.

    Raises StateError if it is no longer running, and the errors of `promote`.
    """
    if promote:
        store.check_bytes(store.version(canary.site, canary.version))
        who = replace(actor, reason=outcome)
        _change(store, canary.site, lambda rows: rules.canary_promotion(rows, canary, who))
    else:
        _change(store, canary.site, lambda rows: rules.canary_withdrawal(rows, canary, outcome, actor))


def difference(store: MapStore, site: str, before: int, after: int) -> Difference:
    """Return the difference between two versions of a site; errors as of `MapStore.manifest`."""
    manifests = (store.manifest(site, before), store.manifest(site, after))
    size = store.version(site, after).manifest_bytes
    return manifest_difference(*manifests, size, lambda sha256: decode_tile(store.blob(sha256)))


def _change(store: MapStore, site: str, decide: Callable[[SiteReleases], ReleaseChanges]) -> ReleaseChanges:
    """As `MapStore.change_releases`; also signs the allowed versions, if the keys are present, and closes surveyed requests."""
    changes = store.change_releases(site, decide)
    try_update_lists(store)
    if any(state == "current" for _, state in changes.states):
        _end_surveyed(store, site)
    return changes


def _end_surveyed(store: MapStore, site: str) -> None:
    """Close requests covered by the current version, or one that it was built on, with its own recordings."""
    waiting = {request.id for request in store.survey_requests(site)}
    known = {info.version: info for info in store.versions(site)} if waiting else {}
    current = store.current(site)
    version = None if current is None else current.version
    while waiting and version in known:
        manifest = store.manifest(site, version)
        said = manifest.report.get(SURVEYED)
        shares = said if isinstance(said, dict) else {}
        for name in sorted(waiting & shares.keys()):
            if isinstance(shares[name], int | float) and shares[name] >= COVERED_SHARE:
                words = f"{IN_USE}{version} surveyed {shares[name]:.0%} of its places"
                store.keep_site_files(site, {KIND + name: None}, words)
                waiting.discard(name)
        version = manifest.parent


def _pass_gate(store: MapStore, draft: VersionInfo, actor: Actor, gate: GateSettings, *, force: bool) -> int | None:
    """Return the version used for comparison; stores the verdict, errors as of `publish`."""
    site = draft.site
    store.check_bytes(draft)
    current = store.current(site)
    verdict = judge_draft(store, draft, gate)
    forced = force and bool(verdict.reasons) and not verdict.hard_reasons
    reasons = (*verdict.hard_reasons, *verdict.reasons)
    row = VerdictRow(store.now_ns(), verdict.accepted, forced, reasons, verdict.report)
    store.record_verdict(draft, row, actor)
    if not verdict.accepted and not forced:
        raise rules.refusal(draft, verdict, store.folder)
    return None if current is None else current.version
