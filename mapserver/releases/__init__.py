"""Releases of an open store: publishing, promoting, rolling back, canaries, and differences between versions.

Each is decided in the transaction that writes it, and is on the disk when it returns.

draft -> current when published; current -> published when another becomes current, -> retired when it is rolled back;
published -> retired by `gc`, once there are enough newer ones; published or retired -> current when promoted.
"""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from fleetmap.encoding import to_plain
from fleetmap.errors import GateRefusedError, InvalidValueError, StateError, UsageError
from fleetmap.mapformat.manifest import decode_manifest
from fleetmap.mapformat.tile import decode_tile
from mapserver.fleet_statistics.canary_decision import threshold_for
from mapserver.floor_plan.survey_requests import COVERED_SHARE, IN_USE, KIND
from mapserver.quality.figures import TRUSTED_KEY, TrustedCalibration, trusted_calibrations
from mapserver.quality.gate import GateSettings, GateVerdict, judge
from mapserver.releases.version_diff import Difference, manifest_difference
from mapserver.store import NOBODY, Actor, CanaryRow, MapStore, SiteReleases, VerdictRow, VersionInfo
from mapserver.store.queries import Release
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
    trust_calibration: bool = False,
    force: bool = False,
    gate: GateSettings = _USUAL_GATE,
) -> int:
    """Take a draft (by default the newest one) through the gate, make it current and return its number.

    trust_calibration: confirms its calibration before, as `confirm_calibration`. force: the gate's reasons are logged with the actor, and
    only its hard limits refuse.

    Raises UsageError for an unknown draft, GateRefusedError for a refused one (its reasons are stored with
    it), StoreError or MapFormatError for one with missing bytes.
    """
    rows = store.releases(site)
    if version is None:
        version = max((info.version for info in rows.versions.values() if info.state == "draft"), default=None)
    if version is None:
        raise UsageError(
            f"site {site} has no draft to publish; make one with `mapserver build RECORDING --site {site}`"
        )
    draft = _draft(rows, version)
    if trust_calibration:
        draft = confirm_calibration(store, draft, actor)
    if force and not (actor.name and actor.reason):
        raise InvalidValueError("publishing by force needs an actor and a reason; add --reason")
    judged_against = _pass_gate(store, draft, actor, gate, force=force)
    with _releasing(store, site) as release:
        left = None if release.rows.current is None else release.rows.current.version
        if left != judged_against:
            raise StateError(
                f"version {left} of site {site} became current while draft {version} was compared with "
                f"{judged_against}; publish again"
            )
        _draft(release.rows, version)
        detail = f"version {version}, " + ("the first" if left is None else f"replacing {left}")
        _make_current(release, version, "published", detail, actor)
    return version


def publish_or_try(
    store: MapStore, site: str, version: int, share: float | None, *, actor: Actor, gate: GateSettings
) -> str:
    """Publish a draft, or start its canary with a share of the robots; return what it is then. Errors as of `publish` and `start_canary`.

    It is published without a share, without a current version, and where fewer than two robots were heard of lately.
    """
    if share is None or len(_heard_of(store, site)) < 2 or store.current(site) is None:
        publish(store, site, version, actor=actor, gate=gate)
        return "current"
    return f"on trial by {start_canary(store, site, version, share, actor=actor, gate=gate).share:.1%} of the robots"


def confirm_calibration(store: MapStore, draft: VersionInfo, actor: Actor) -> VersionInfo:
    """Return the draft with an operator's confirmation of its calibrations in its manifest.

    It stays a draft for the gate to judge. The confirmation names calibrations by their fingerprint: versions built on this one
    inherit it, other calibrations do not. No change if recordings judged all of them, or they are already trusted.

    Raises UsageError without a name and a reason, StateError for a version that is not a draft, StoreError on a disk error.
    """
    if not (actor.name and actor.reason):
        raise InvalidValueError("trusting a calibration needs an actor and a reason; add --reason")
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
    return store.replace_manifest(draft, changed, "calibration trusted", detail, actor)


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
    with _releasing(store, site) as release:
        _promote(release, version, actor)


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
        end_canary(store, rows.canary, promote=False, outcome=outcome, actor=actor, by_hand=True)
        return rows.canary.base_version
    if rows.rollback_target is not None:
        store.check_bytes(rows.versions[rows.rollback_target])
    with _releasing(store, site) as release:
        current, target = release.rows.current, release.rows.rollback_target
        if to is not None and (to != target or release.rows.canary is not None):
            raise StateError(f"a rollback of site {site} no longer leads to version {to}; check `versions`")
        if current is None or target is None:
            raise StateError(f"site {site} has no earlier current version; `versions` lists versions to promote")
        release.roll_back(target)
        release.log("rolled_back", f"from version {current.version} to {target}", target, actor)
        return target


def start_canary(
    store: MapStore, site: str, version: int, share: float, *, actor: Actor = NOBODY, gate: GateSettings = _USUAL_GATE
) -> CanaryRow:
    """Let a share of the site's robots run a version before the others; a draft goes through the gate first.

    Raises UsageError for an unknown version or a share outside of 0 to 1, StateError if the site has no current version, it is
    `version`, or a canary is running, and the errors of `publish` for drafts.
    """
    rows = store.releases(site)
    wanted = _known(rows, version)
    if not 0 < share < 1:
        raise UsageError(f"a canary of {share:g} of the robots: name a share between 0 and 1, such as 5%")
    if rows.current is None or rows.current.version == version:
        held = "has no current version" if rows.current is None else f"has version {version} as its current one"
        raise StateError(f"site {site} {held}; a canary is compared with another, current version")
    if rows.canary is not None:
        raise StateError(f"site {site} has a canary of version {rows.canary.version}; `rollback` withdraws it")
    base = rows.current.version
    if wanted.state == "draft":
        _pass_gate(store, wanted, actor, gate, force=False)
    else:
        store.check_bytes(wanted)
    robots = _heard_of(store, site)
    with _releasing(store, site) as release:
        current = release.rows.current
        if current is None or current.version != base or release.rows.canary is not None:
            raise StateError(f"site {site} was changed meanwhile by another operator; check `versions` and try again")
        if _known(release.rows, version).state == "draft":
            release.log("admitted", f"version {version}, not current yet", version, actor)
        release.begin_canary(version, base, share, threshold_for(share, site, version, robots), actor)
        detail = f"version {version} for {share:.1%} of the robots, beside version {base}"
        release.log("canary_started", detail, version, actor)
    return store.canaries(site, running=True)[0]


def _heard_of(store: MapStore, site: str) -> list[str]:
    recent_ns = store.now_ns() - _RECENT_NS
    return [robot.robot for robot in store.robots(site) if robot.last_seen_ns >= recent_ns]


def end_canary(
    store: MapStore, canary: CanaryRow, *, promote: bool, outcome: str, actor: Actor = NOBODY, by_hand: bool = False
) -> None:
    """Make the canary's version current, or withdraw it from its robots, stopped by hand or rolled back, and retire it.

    Raises StateError if it is no longer running, and the errors of `promote`.
    """
    if promote:
        store.check_bytes(store.version(canary.site, canary.version))
    who, tried = actor._replace(reason=outcome), canary.version
    with _releasing(store, canary.site) as release:
        rows = release.rows
        if rows.canary is None or rows.canary.id != canary.id:
            raise StateError(f"version {tried} of site {canary.site} is no longer a canary; check `versions`")
        if promote:
            _promote(release, tried, who)
            return
        if tried in rows.versions and rows.versions[tried].state == "published":
            release.set_state(tried, "retired")
        release.end_canary("stopped" if by_hand else "rolled_back", outcome)
        detail = f"version {tried}; version {canary.base_version} stays current"
        release.log("canary_rolled_back", detail, tried, who)


def difference(store: MapStore, site: str, before: int, after: int) -> Difference:
    """Return the difference between two versions of a site; errors as of `MapStore.manifest`."""
    manifests = (store.manifest(site, before), store.manifest(site, after))
    size = store.version(site, after).manifest_bytes
    return manifest_difference(*manifests, size, lambda sha256: decode_tile(store.blob(sha256)))


@contextmanager
def _releasing(store: MapStore, site: str) -> Iterator[Release]:
    """As `MapStore.releasing`; also signs the allowed versions, if the keys are present, and closes surveyed requests."""
    with store.releasing(site) as release:
        yield release
    try_update_lists(store)
    if release.has_new_current:
        _end_surveyed(store, site)


def _promote(release: Release, version: int, actor: Actor) -> None:
    """Make a published or retired version current, no change if it is."""
    wanted, current, site = _known(release.rows, version), release.rows.current, release.rows.site
    if wanted.state == "draft":
        raise StateError(
            f"version {version} of site {site} is a draft; `mapserver publish --site {site} --version {version}` takes it "
            "through the gate"
        )
    if wanted.state != "current":
        left = None if current is None else current.version
        _make_current(release, version, "promoted", f"version {version}, replacing {left}", actor)


def _make_current(release: Release, version: int, kind: str, detail: str, actor: Actor) -> None:
    """Make a version current and end a running canary, whose comparison is over."""
    if (canary := release.rows.canary) is not None:
        is_promoted = canary.version == version
        outcome = actor.reason if is_promoted and actor.reason else f"version {version} became current"
        release.end_canary("promoted" if is_promoted else "stopped", outcome)
        ended, who = "canary_promoted" if is_promoted else "canary_stopped", actor._replace(reason=outcome)
        release.log(ended, f"version {canary.version}", canary.version, who)
    release.make_current(version)
    release.log(kind, detail, version, actor)


def _known(rows: SiteReleases, version: int) -> VersionInfo:
    if version not in rows.versions:
        site = rows.site
        raise UsageError(f"site {site} has no version {version}; `mapserver versions --site {site}` lists them")
    return rows.versions[version]


def _draft(rows: SiteReleases, version: int) -> VersionInfo:
    info = _known(rows, version)
    if info.state != "draft":
        raise StateError(f"version {version} of site {rows.site} is {info.state}, only a draft can be published")
    return info


def _end_surveyed(store: MapStore, site: str) -> None:
    """Close requests covered by the current version, or one that it was built on, with its own recordings."""
    waiting = {request.id for request in store.survey_requests(site)}
    known = {info.version for info in store.versions(site)} if waiting else set()
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
    store.check_bytes(draft)
    current = store.current(draft.site)
    verdict = judge_draft(store, draft, gate)
    is_forced = force and bool(verdict.reasons) and not verdict.hard_reasons
    reasons = (*verdict.hard_reasons, *verdict.reasons)
    row = VerdictRow(store.now_ns(), verdict.accepted, is_forced, reasons, verdict.report)
    store.record_verdict(draft, row, actor)
    if not verdict.accepted and not is_forced:
        raise _refusal(draft, verdict, store.folder)
    return None if current is None else current.version


def _refusal(draft: VersionInfo, verdict: GateVerdict, store: Path) -> GateRefusedError:
    """Return the error for a refused draft; its last line is the command that publishes it nevertheless, if possible."""
    words = f"draft {draft.version} of {draft.site} is refused: {'; '.join((*verdict.hard_reasons, *verdict.reasons))}"
    if verdict.hard_reasons:
        return GateRefusedError(f"{words}; this cannot be forced")
    when, option = "To publish it nevertheless", "--force"
    if set(verdict.reasons) == set(verdict.unjudged):
        when = "Record the missing data, or, if you know that the calibration is right"
        option = "--trust-calibration"
    where = f"--site {draft.site} --store {shlex.quote(str(store))} --version {draft.version}"
    return GateRefusedError(
        f"{words}; `mapserver inspect {where}` shows the draft\n{when}:\n  mapserver publish {where} {option} --reason 'WHY'"
    )
