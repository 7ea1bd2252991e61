"""The page of people and robots: who may do what here? Operators with role, sessions and tokens; robots and their enrolment."""

import time
from typing import NamedTuple

from fleetmap.errors import StateError
from mapserver.api.people_routes import enrolled_of, operators_of
from mapserver.api.views import EnrolledRobot
from mapserver.dashboard.console import PageContext, Services
from mapserver.dashboard.live import ORDER, LiveRobot
from mapserver.operators.operators import MAX_TOKEN_DAYS
from mapserver.operators.roles import OPERATOR_PATTERN, SCOPES, Role, Scope
from mapserver.trust.enrolment import RobotRegister

_SOON_DAYS = 30
_MOST_ROBOTS = 500
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


def page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    store, now_ns = services.maps.store, time.time_ns()
    enrolled = {row.robot: row for row in enrolled_of(store, context.site)}
    heard = {robot.name: robot for robot in services.robots.look(context.site).robots}
    robots = [_Robot(name, heard.get(name), enrolled.get(name)) for name in {*enrolled, *heard}]
    return {
        "operators": operators_of(store),
        "roles": _ROLES,
        "rights": _RIGHTS,
        "scopes": {role: [scope for scope in Scope if scope in scopes] for role, scopes in SCOPES.items()},
        "name_pattern": OPERATOR_PATTERN.strip("^$").replace("+-", r"+\-"),
        "most_days": MAX_TOKEN_DAYS,
        "left": lambda token: (token.ends_ns - now_ns) / 1e9,
        "robots": sorted(robots, key=lambda robot: (ORDER[robot.tone], robot.name)),
        "most": _MOST_ROBOTS,
        "cannot_enrol": cannot_enrol(RobotRegister(store)),
    }


def cannot_enrol(register: RobotRegister) -> str:
    """Why no robot can be enrolled, empty if one can."""
    try:
        _ = register.tls
    except StateError as error:
        return str(error)
    return ""
