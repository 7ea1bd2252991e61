"""Endpoints of operators, tokens and enrolled robots. The guard requires the rights `operators` and `robots`, also for reading.

A right is given by those who have it: a token that manages operators cannot make an admin of anybody.
"""

from collections.abc import Iterable

from fastapi import FastAPI, Request, Response
from starlette.exceptions import HTTPException

from fleetmap.bus.endpoints import check_endpoint, has_tls
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import StateError, UsageError
from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.guard import actor_of
from mapserver.operators.operators import Operators
from mapserver.operators.roles import SCOPES, Identity, Role
from mapserver.store import MapStore
from mapserver.trust.enrolment import LISTENING, RobotRegister

_ONCE = {"Cache-Control": "no-store"}


def operators_of(store: MapStore) -> list[views.OperatorView]:
    """Return operators and programs with their valid tokens, by name."""
    tokens: dict[str, list[views.TokenView]] = {}
    for token in store.operators.tokens(store.now_ns()):
        tokens.setdefault(token.name, []).append(
            views.TokenView(token.sha256[:12], token.scopes.split(), token.ends_ns)
        )
    return [
        views.OperatorView(row.name, row.role, bool(row.is_disabled), row.sessions, tokens.get(row.name, []))
        for row in Operators(store).all()
    ]


def enrolled_of(store: MapStore, site: str) -> list[views.EnrolledRobot]:
    """Return the enrolled robots of a site, by name."""
    return [views.EnrolledRobot(**entry.row(store.now_ns())) for entry in RobotRegister(store).robots(site)]


def install_people_routes(app: FastAPI, store: MapStore, operators: Operators, bus: Bus | None) -> None:
    """Add the endpoints. bus: where enrolled robots reach the server, if it has TLS."""
    _install_operator_routes(app, store, operators)
    _install_robot_routes(app, store, bus)


def _install_operator_routes(app: FastAPI, store: MapStore, operators: Operators) -> None:
    @app.get("/v1/operators")
    def list_operators(limit: p.Limit = 100, cursor: p.NameCursor = None) -> views.OperatorList:
        """Operators and programs by name, with their sessions and tokens."""
        found = [operator for operator in operators_of(store) if cursor is None or operator.name > cursor]
        return views.OperatorList(*p.page(found, limit, lambda operator: operator.name))

    @app.post("/v1/operators")
    def add_operator(request: Request, response: Response, act: views.OperatorAct) -> views.Secret:
        """Add an operator; this answer alone has the password. The first operator is an admin: from then on everybody signs in."""
        actor = actor_of(request, act.actor, act.reason)
        if act.role is not Role.ADMIN and _sender(request) is None:
            raise StateError(f"{act.name} would be the first operator, and could add nobody; begin with an admin")
        _check_has(request, SCOPES[act.role])
        response.headers.update(_ONCE)
        return views.Secret(act.name, operators.add(act.name, act.role, None, actor))

    @app.post("/v1/operators/{operator}/password")
    def renew_password(request: Request, response: Response, operator: p.Operator, act: views.Act) -> views.Secret:
        """Give an operator another password, also a disabled one; the sessions end. This answer alone has it."""
        row = store.operators.find(operator)
        _check_has(request, () if row is None else SCOPES[row.role])
        response.headers.update(_ONCE)
        made = operators.set_password(operator, None, actor_of(request, act.actor, act.reason))
        return views.Secret(operator, made)

    @app.post("/v1/operators/{operator}/role")
    def change_role(request: Request, operator: p.Operator, act: views.RoleAct) -> views.ServiceState:
        """Give an operator another role, from the next request on; 409 for the last admin."""
        _check_has(request, SCOPES[act.role])
        operators.set_role(operator, act.role, actor_of(request, act.actor, act.reason), keeps_an_admin=True)
        return views.ServiceState("ok")

    @app.post("/v1/operators/{operator}/disable")
    def disable_operator(request: Request, operator: p.Operator, act: views.Act) -> views.ServiceState:
        """End the sessions and tokens of an operator or program at once, and refuse its sign-in; 409 for the last admin."""
        store.operators.disable(operator, actor_of(request, act.actor, act.reason), keeps_an_admin=True)
        return views.ServiceState("ok")

    @app.post("/v1/tokens")
    def make_token(request: Request, response: Response, act: views.TokenAct) -> views.Secret:
        """Make a token for an operator or a program; this answer alone has it. 403 for scopes that its maker lacks."""
        actor = actor_of(request, act.actor, act.reason)
        if _sender(request) is None:
            raise StateError("with the first token everybody signs in, and nobody could; add an admin before it")
        _check_has(request, act.scopes)
        response.headers.update(_ONCE)
        return views.Secret(act.name, operators.make_token(act.name, act.scopes, act.days, actor))

    @app.post("/v1/tokens/{token}/revoke")
    def revoke_token(request: Request, token: p.TokenNumber, act: views.Act) -> views.ServiceState:
        """End one token at once; the other tokens of its owner stay."""
        store.operators.revoke_token(token, actor_of(request, act.actor, act.reason))
        return views.ServiceState("ok")


def _install_robot_routes(app: FastAPI, store: MapStore, bus: Bus | None) -> None:
    register = RobotRegister(store)

    def own_endpoint() -> str:
        # Asked late: an open bus knows its port.
        return register.default_endpoint(bus.endpoint if bus is not None and has_tls(bus.endpoint) else LISTENING)

    @app.get("/v1/sites/{site}/enrolled")
    def enrolled_robots(site: p.Site, limit: p.Limit = 100, cursor: p.NameCursor = None) -> views.EnrolledList:
        """Robots of a site that are admitted to the bus, with the days until their certificates end."""
        found = [row for row in enrolled_of(store, site) if cursor is None or row.robot > cursor]
        return views.EnrolledList(*p.page(found, limit, lambda row: row.robot))

    @app.post("/v1/sites/{site}/enrolled", response_class=Response)
    def enrol_robot(request: Request, site: p.Site, act: views.EnrolAct) -> Response:
        """Admit a robot to the bus: the answer is its bundle for `locclient enrol`, a secret until it is used, once, within a day."""
        try:
            endpoint = own_endpoint() if act.endpoint is None else check_endpoint(act.endpoint)
        except StateError:
            raise
        except UsageError as error:
            raise HTTPException(422, str(error)) from error
        made = register.enrol(site, [act.robot], endpoint, actor=actor_of(request, act.actor, act.reason))
        headers = {"Content-Disposition": f'attachment; filename="{act.robot}.fleetmap"', **_ONCE}
        return Response(made[act.robot], media_type="application/octet-stream", headers=headers)

    @app.post("/v1/sites/{site}/enrolled/{robot}/revoke")
    def revoke_robot(request: Request, site: p.Site, robot: p.Robot, act: views.Act) -> views.ServiceState:
        """Remove a robot, such as a stolen one, from the bus within two seconds."""
        if not register.revoke(site, [robot], actor=actor_of(request, act.actor, act.reason)):
            raise HTTPException(
                404, f"site {site} has not enrolled {robot}; GET /v1/sites/{site}/enrolled lists its robots"
            )
        return views.ServiceState("ok")

    @app.post("/v1/sites/{site}/robots/{robot}/remove")
    def remove_robot(request: Request, site: p.Site, robot: p.Robot, act: views.Act) -> views.ServiceState:
        """Remove a robot from lists within seconds; its counts and failures stay. If it reports again, it is added again."""
        if not store.remove_robots(site, [robot], actor=actor_of(request, act.actor, act.reason)):
            raise HTTPException(404, f"site {site} knows no robot {robot}; GET /v1/robots?site={site} lists them")
        return views.ServiceState("ok")


def _sender(request: Request) -> Identity | None:
    """Return who signed in, None while sign-in is off."""
    who: Identity | None = getattr(request.state, "operator", None)
    return who


def _check_has(request: Request, scopes: Iterable[str]) -> None:
    """Raise 403 for rights that the sender lacks."""
    who = _sender(request)
    if who is not None and (beyond := set(scopes) - who.scopes):
        raise HTTPException(403, f"{who.name} cannot give the right to {sorted(beyond)[0]!r} without having it")
