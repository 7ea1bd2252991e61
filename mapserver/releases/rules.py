"""Rules of releases: versions that may become current, and the resulting changes. Pure functions over rows of the store.

draft -> current when published; current -> published when another becomes current, -> retired when it is rolled back;
published -> retired by `gc`, once there are enough newer ones; published or retired -> current when promoted.
"""

import shlex
from dataclasses import replace
from pathlib import Path

from fleetmap.errors import GateRefusedError, StateError, UsageError
from mapserver.quality.gate import GateVerdict
from mapserver.store.rows import (
    Actor,
    CanaryEnd,
    CanaryRow,
    LogEntry,
    NewCanary,
    ReleaseChanges,
    SiteReleases,
    VersionInfo,
)


def chosen_draft(rows: SiteReleases, number: int | None) -> VersionInfo:
    """Return the draft of this number, by default the newest one; UsageError without any, StateError for a version that is not a draft."""
    if number is not None:
        return _draft(rows, number)
    drafts = [info for info in rows.versions.values() if info.state == "draft"]
    if not drafts:
        reason = (
            f"site {rows.site} has no draft to publish; make one with `mapserver build RECORDING --site {rows.site}`"
        )
        raise UsageError(reason)
    return drafts[-1]


def refusal(draft: VersionInfo, verdict: GateVerdict, store: Path) -> GateRefusedError:
    """Return the error for a refused draft; its last line is the command that publishes it nevertheless, if possible."""
    words = f"draft {draft.version} of {draft.site} is refused: {'; '.join((*verdict.hard_reasons, *verdict.reasons))}"
    if verdict.hard_reasons:
        return GateRefusedError(f"{words}; this cannot be forced")
    trusts = set(verdict.reasons) == set(verdict.unjudged)
    when = (
        "Record the missing data, or, if you know that the calibration is right"
        if trusts
        else "To publish it nevertheless"
    )
    where = f"--site {draft.site} --store {shlex.quote(str(store))} --version {draft.version}"
    option = "--trust-calibration" if trusts else "--force"
    return GateRefusedError(
        f"{words}; `mapserver inspect {where}` shows the draft\n{when}:\n  mapserver publish {where} {option} --reason 'WHY'"
    )


def publication(rows: SiteReleases, draft: int, judged_against: int | None, actor: Actor) -> ReleaseChanges:
    """Make a draft current that was compared with version `judged_against`; StateError if another version became current meanwhile."""
    left = None if rows.current is None else rows.current.version
    if left != judged_against:
        raise StateError(
            f"version {left} of site {rows.site} became current while draft {draft} was compared with "
            f"{judged_against}; publish again"
        )
    _draft(rows, draft)
    detail = f"version {draft}, " + ("the first" if left is None else f"replacing {left}")
    return _becomes_current(rows, draft, LogEntry("published", detail, draft, actor))


def promotion(rows: SiteReleases, version: int, actor: Actor) -> ReleaseChanges:
    """Make a published or retired version current, no change if it is; StateError for a draft."""
    wanted = _known(rows, version)
    if wanted.state == "current":
        return ReleaseChanges()
    if wanted.state == "draft":
        raise StateError(
            f"version {version} of site {rows.site} is a draft; `mapserver publish --site {rows.site} --version {version}` takes it "
            "through the gate"
        )
    left = None if rows.current is None else rows.current.version
    return _becomes_current(rows, version, LogEntry("promoted", f"version {version}, replacing {left}", version, actor))


def rollback(rows: SiteReleases, actor: Actor, to: int | None = None) -> ReleaseChanges:
    """Make the previous current version current and retire the present one; StateError without a previous one, or if it is not `to`."""
    current, target = rows.current, rows.rollback_target
    if to is not None and (to != target or rows.canary is not None):
        raise StateError(f"a rollback of site {rows.site} no longer leads to version {to}; check `versions`")
    if current is None or target is None:
        raise StateError(f"site {rows.site} has no earlier current version; `versions` lists versions to promote")
    detail = f"from version {current.version} to {target}"
    return ReleaseChanges(
        states=((current.version, "retired"), (target, "current")),
        drop_currents_after=rows.rollback_row,
        log=(LogEntry("rolled_back", detail, target, actor),),
    )


def check_canary(rows: SiteReleases, version: int, share: float) -> VersionInfo:
    """Return the current version, the reference for a canary of `version`.

    Raises UsageError for an unknown version or a share outside of 0 to 1, StateError if the site has no current version, it is
    `version`, or a canary is running.
    """
    _known(rows, version)
    if not 0 < share < 1:
        raise UsageError(f"a canary of {share:g} of the robots: name a share between 0 and 1, such as 5%")
    if rows.current is None or rows.current.version == version:
        held = "has no current version" if rows.current is None else f"has version {version} as its current one"
        raise StateError(f"site {rows.site} {held}; a canary is compared with another, current version")
    if rows.canary is not None:
        raise StateError(f"site {rows.site} has a canary of version {rows.canary.version}; `rollback` withdraws it")
    return rows.current


def canary_start(rows: SiteReleases, new: NewCanary) -> ReleaseChanges:
    """Start a canary; a draft becomes a published version that is not current.

    Raises StateError if another version became current meanwhile or another canary began, and the errors of `check_canary`.
    """
    if rows.current is None or rows.current.version != new.base_version or rows.canary is not None:
        raise StateError(f"site {rows.site} was changed meanwhile by another operator; check `versions` and try again")
    check_canary(rows, new.version, new.share)
    detail = f"version {new.version} for {new.share:.1%} of the robots, beside version {new.base_version}"
    log: tuple[LogEntry, ...] = (LogEntry("canary_started", detail, new.version, new.actor),)
    if rows.versions[new.version].state == "draft":
        log = (LogEntry("admitted", f"version {new.version}, not current yet", new.version, new.actor), *log)
    return ReleaseChanges(states=((new.version, "published"),), new_canary=new, log=log)


def canary_promotion(rows: SiteReleases, canary: CanaryRow, actor: Actor) -> ReleaseChanges:
    """Make the canary's version current; raises StateError if it is no longer running."""
    _check_running(rows, canary)
    return promotion(rows, canary.version, actor)


def canary_withdrawal(
    rows: SiteReleases, canary: CanaryRow, outcome: str, actor: Actor, *, by_hand: bool = False
) -> ReleaseChanges:
    """End a canary, stopped by hand or rolled back, and retire its version; raises StateError if it is no longer running."""
    _check_running(rows, canary)
    detail = f"version {canary.version}; version {canary.base_version} stays current"
    entry = LogEntry("canary_rolled_back", detail, canary.version, replace(actor, reason=outcome))
    is_published = canary.version in rows.versions and rows.versions[canary.version].state == "published"
    return ReleaseChanges(
        states=((canary.version, "retired"),) if is_published else (),
        ended_canary=CanaryEnd(canary.id, "stopped" if by_hand else "rolled_back", outcome),
        log=(entry,),
    )


def _becomes_current(rows: SiteReleases, version: int, entry: LogEntry) -> ReleaseChanges:
    """Make a version current and end a running canary, whose comparison is over."""
    left = () if rows.current is None else ((rows.current.version, "published"),)
    states = (*left, (version, "current"))
    if rows.canary is None:
        return ReleaseChanges(states=states, new_current=version, log=(entry,))
    tried, actor = rows.canary.version, entry.actor
    is_promoted = tried == version
    outcome = actor.reason if is_promoted and actor.reason else f"version {version} became current"
    kind = "canary_promoted" if is_promoted else "canary_stopped"
    end = LogEntry(kind, f"version {tried}", tried, replace(actor, reason=outcome))
    return ReleaseChanges(
        states=states,
        new_current=version,
        ended_canary=CanaryEnd(rows.canary.id, "promoted" if is_promoted else "stopped", outcome),
        log=(end, entry),
    )


def _check_running(rows: SiteReleases, canary: CanaryRow) -> None:
    if rows.canary is None or rows.canary.id != canary.id:
        raise StateError(f"version {canary.version} of site {canary.site} is no longer a canary; check `versions`")


def _known(rows: SiteReleases, version: int) -> VersionInfo:
    if version not in rows.versions:
        reason = f"site {rows.site} has no version {version}; `mapserver versions --site {rows.site}` lists them"
        raise UsageError(reason)
    return rows.versions[version]


def _draft(rows: SiteReleases, version: int) -> VersionInfo:
    info = _known(rows, version)
    if info.state != "draft":
        raise StateError(f"version {version} of site {rows.site} is {info.state}, only a draft can be published")
    return info
