"""The pages of the server (is it well? alerts, disk, what expires, for how long reports are kept), of people and robots, and of the log.

Those say who may do what here: operators with role, sessions and tokens; robots and their enrolment. The log says what people did.
"""

import re
import time
from typing import NamedTuple

from fleetmap.errors import StateError
from mapserver.api.people_routes import enrolled_of, operators_of
from mapserver.dashboard.console import PageContext, Services, number
from mapserver.dashboard.live import ORDER, LiveRobot, counted
from mapserver.dashboard.rendering import size
from mapserver.fleet.alerts import active_alerts
from mapserver.operators.operators import MAX_TOKEN_DAYS
from mapserver.operators.roles import OPERATOR_PATTERN, SCOPES, Role, Scope
from mapserver.serving.server_health import Ending, ServerHealth, server_health
from mapserver.trust.enrolment import EnrolledRobot, RobotRegister

_NAMES = {
    "http": "Certificate of these pages",
    "server.pem": "Certificate of the server for robots",
    "servers-ca.crt": "Authority of servers",
    "robots-ca.crt": "Authority of robots",
    "root": "List of keys",
    "targets": "List of sites",
    "snapshot": "List of lists",
    "timestamp": "Proof that lists are fresh",
    "all": "Signed lists",
}
_RENEWED = "renewed by the server itself"
_BY_SERVER = ("snapshot", "timestamp", "site-")
_SOON_DAYS = 30
_MOST_ROBOTS = _MOST_LINES = 500
LOG_FILTERS = ("person", "where", "kind")
_OF_REQUEST = re.compile(r" [0-9a-f]{8}$")  # in the kind of its lines
_ROLES = {
    Role.VIEWER: "viewer: reads",
    Role.OPERATOR: "operator: publishes and rolls back, too",
    Role.ADMIN: "admin: everything, people and robots, too",
}
_RIGHTS = {
    Scope.READ: "read maps, robots and failures",
    Scope.METRICS: "read the metrics",
    Scope.CHANGE: "publish, roll back, place robots, ask for surveys",
    Scope.ROBOTS: "enrol, revoke and remove robots",
    Scope.OPERATORS: "manage operators and tokens",
}


def page(services: Services, _: PageContext) -> dict[str, object]:
    """What the template needs."""
    store, settings, now_ns = services.maps.store, services.settings, time.time_ns()
    found = server_health(store, services.robots.fleet, settings.config.ingest, settings.certificate)
    kept = found.retention
    return {
        "alerts": active_alerts(store, services.robots.fleet, settings.config.alerts, now_ns),
        "now_ns": now_ns,
        "webhook": settings.webhook,
        "found": found,
        "facts_of_server": [("Version", found.fleetmap), ("Memory", size(found.memory_bytes))],
        "disk": _disk(found),
        "endings": [ending_row(ending) for ending in found.endings],
        "retention": [
            ("Figures by the hour", f"{kept.tally_days:g} days"),
            ("Failures", f"{kept.failure_days:g} days, {kept.failures_per_robot} of a robot"),
            ("Their pictures", f"{kept.picture_days:g} days, the newest {size(kept.picture_bytes)}"),
            ("Their recordings", f"{kept.replay_days:g} days, the newest {size(found.replay_bytes)}"),
            ("Ways of robots", f"{kept.trace_days:g} days"),
            ("Pictures of surveys", f"{kept.survey_picture_days:g} days since they were taken"),
            ("Recordings of surveys", f"{kept.recording_days:g} days since a night took or refused them"),
            ("Versions of maps", "until somebody runs mapserver gc"),
        ],
    }


def _disk(found: ServerHealth) -> list[tuple[str, str, int]]:
    """Shades, names and bytes of the disk's parts, the free one last."""
    used, own = found.store, list[tuple[str, str, int]]()
    if used is not None:
        own = [
            ("shade-0", "Maps", used.maps_bytes),
            ("shade-1", "Pictures of failures", used.pictures_bytes),
            ("shade-2", "Recordings of failures", used.recordings_bytes),
            ("shade-3", "Rest of the database", used.database_bytes),
        ]
    others = found.disk.total_bytes - found.disk.free_bytes - sum(part for _, _, part in own)
    named = "Everything else on this disk" if own else "Used"
    return [*own, ("shade-5", named, max(0, others)), ("free", "Free", found.disk.free_bytes)]


def ending_row(ending: Ending) -> tuple[str, str, str, str]:
    """Name, tone, time left and remark; who only has to wait for the server is told so."""
    name = _NAMES.get(ending.name) or f"Maps of {ending.name.removeprefix('site-')}"
    remark = ending.fault or (_RENEWED if ending.name.startswith(_BY_SERVER) else "")
    days = ending.days_left
    if days is None:
        return name, "bad", "unknown", remark
    left = "ended" if days <= 0 else f"{24 * days:.0f} h" if days < 2 else f"{days:.0f} days"
    return name, "good" if not ending.fault else "warn" if days > 0 else "bad", left, remark


class _Robot(NamedTuple):
    """A robot that is enrolled, heard, or both."""

    name: str
    heard: LiveRobot | None
    enrolled: EnrolledRobot | None

    @property
    def tone(self) -> str:
        if self.enrolled is None:
            return "quiet"
        if self.enrolled.days_left <= 0:
            return "bad"
        return "good" if self.enrolled.is_used and self.enrolled.days_left > _SOON_DAYS else "warn"


def people(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    store, now_ns = services.maps.store, time.time_ns()
    enrolled = {row.robot: row for row in enrolled_of(store, context.site)}
    heard = {robot.name: robot for robot in services.robots.look(context.site)}
    robots = [_Robot(name, heard.get(name), enrolled.get(name)) for name in {*enrolled, *heard}]
    return {
        "allowed": {line.detail: line for line in reversed(store.log(site=context.site, kind="robot enrolled"))},
        "operators": operators_of(store),
        "roles": _ROLES,
        "rights": _RIGHTS,
        "scopes": {role: [scope for scope in Scope if scope in scopes] for role, scopes in SCOPES.items()},
        "name_pattern": OPERATOR_PATTERN.strip("^$").replace("+-", r"+\-"),
        "most_days": MAX_TOKEN_DAYS,
        "left": lambda token: (token.ends_ns - now_ns) / 1e9,
        "robots": sorted(robots, key=lambda robot: (ORDER[robot.tone], counted(robot.name))),
        "most": _MOST_ROBOTS,
        "cannot_enrol": cannot_enrol(RobotRegister(store)),
    }


def log(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs: who did what, where, when and why, the last first."""
    store, chosen = services.maps.store, {name: context.query.get(name) or None for name in LOG_FILTERS}
    before, span_ns = number(context.query.get("older"), "line"), context.time_range()
    asked = {"person": chosen["person"], "site": chosen["where"], "kind": chosen["kind"]}
    lines = store.log(**asked, of_people=True, span_ns=span_ns, before=before, limit=_MOST_LINES + 1)
    kept, has_more = chosen | {"find": context.query.get("find")}, len(lines) > _MOST_LINES
    kinds = sorted({_OF_REQUEST.sub("", kind) for kind in store.log_values("kind")})
    return {
        "filters": [
            ("person", "Person", "everybody", store.log_values("actor")),
            ("where", "Site", "anywhere", store.log_values("site")),
            ("kind", "Kind", "everything", kinds),
        ],
        "chosen": chosen,
        "lines": lines[:_MOST_LINES],
        "older": context.to("administration/log", **kept, older=lines[-2].id) if has_more else None,
    }


def cannot_enrol(register: RobotRegister) -> str:
    """Why no robot can be enrolled, empty if one can."""
    try:
        _ = register.tls
    except StateError as error:
        return str(error)
    return ""
