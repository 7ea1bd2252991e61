"""Endpoints of operators, tokens and enrolled robots. The guard requires the rights `operators` and `robots`, also for reading.

A right is given by those who have it: a token that manages operators cannot make an admin of anybody.
"""

from typing import Any

from fastapi import APIRouter, Response
from starlette.exceptions import HTTPException

from fleetmap.bus.endpoints import check_endpoint, has_tls
from fleetmap.errors import StateError
from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.guard import Sender
from mapserver.api.problems import refused_with
from mapserver.operators.operators import Operators
from mapserver.operators.roles import SCOPES, Role
from mapserver.store import MapStore
from mapserver.trust.enrolment import LISTENING, EnrolledRobot, RobotRegister

_ONCE = {"Cache-Control": "no-store"}
router = APIRouter()


def operators_of(store: MapStore) -> list[views.OperatorView]:
    """Return operators and programs with their valid tokens, by name."""
    tokens: dict[str, list[views.TokenView]] = {}
    for token in store.operators.tokens(store.now_ns()):
        view = views.TokenView(number=token.sha256[:12], scopes=token.scopes.split(), ends_ns=token.ends_ns)
        tokens.setdefault(token.name, []).append(view)
    return [
        views.OperatorView(
            name=row.name,
            role=row.role,
            is_disabled=bool(row.is_disabled),
            sessions=row.sessions,
            tokens=tokens.get(row.name, []),
        )
        for row in Operators(store).all()
    ]


def enrolled_of(store: MapStore, site: str) -> list[EnrolledRobot]:
    """Return the enrolled robots of a site, by name."""
    return [entry.shown(store.now_ns()) for entry in RobotRegister(store).robots(site)]


@router.get("/v1/operators", response_model=views.OperatorList)
def list_operators(store: p.Store, page: p.NamePage) -> Any:
    """Operators and programs by name, with their sessions and tokens."""
    return page.of(views.OperatorList, operators_of(store), lambda operator: operator.name)


@router.post("/v1/operators")
def add_operator(service: p.Service, sender: Sender, response: Response, act: views.OperatorAct) -> views.Secret:
    """Add an operator; this answer alone has the password. The first operator is an admin: from then on everybody signs in."""
    actor = sender.of(act)
    if act.role is not Role.ADMIN and sender.who is None:
        raise StateError(f"{act.name} would be the first operator, and could add nobody; begin with an admin")
    sender.check_has(SCOPES[act.role])
    response.headers.update(_ONCE)
    return views.Secret(name=act.name, secret=service.operators.add(act.name, act.role, None, actor))


@router.post("/v1/operators/{operator}/password")
def renew_password(
    service: p.Service, sender: Sender, response: Response, operator: p.Operator, act: views.Act
) -> views.Secret:
    """Give an operator another password, also a disabled one; the sessions end. This answer alone has it."""
    row = service.store.operators.find(operator)
    sender.check_has(() if row is None else SCOPES[row.role])
    response.headers.update(_ONCE)
    return views.Secret(name=operator, secret=service.operators.set_password(operator, None, sender.of(act)))


@router.post("/v1/operators/{operator}/role")
def change_role(service: p.Service, sender: Sender, operator: p.Operator, act: views.RoleAct) -> views.ServiceState:
    """Give an operator another role, from the next request on; 409 for the last admin."""
    sender.check_has(SCOPES[act.role])
    service.operators.set_role(operator, act.role, sender.of(act), keeps_an_admin=True)
    return views.OK


@router.post("/v1/operators/{operator}/disable")
def disable_operator(store: p.Store, sender: Sender, operator: p.Operator, act: views.Act) -> views.ServiceState:
    """End the sessions and tokens of an operator or program at once, and refuse its sign-in; 409 for the last admin."""
    store.operators.disable(operator, sender.of(act), keeps_an_admin=True)
    return views.OK


@router.post("/v1/tokens")
def make_token(service: p.Service, sender: Sender, response: Response, act: views.TokenAct) -> views.Secret:
    """Make a token for an operator or a program; this answer alone has it. 403 for scopes that its maker lacks."""
    actor = sender.of(act)
    if sender.who is None:
        raise StateError("with the first token everybody signs in, and nobody could; add an admin before it")
    sender.check_has(act.scopes)
    response.headers.update(_ONCE)
    return views.Secret(name=act.name, secret=service.operators.make_token(act.name, act.scopes, act.days, actor))


@router.post("/v1/tokens/{token}/revoke")
def revoke_token(store: p.Store, sender: Sender, token: p.TokenNumber, act: views.Act) -> views.ServiceState:
    """End one token at once; the other tokens of its owner stay."""
    store.operators.revoke_token(token, sender.of(act))
    return views.OK


@router.get("/v1/sites/{site}/enrolled", response_model=views.EnrolledList)
def enrolled_robots(store: p.Store, site: p.Site, page: p.NamePage) -> Any:
    """Robots of a site that are admitted to the bus, with the days until their certificates end."""
    return page.of(views.EnrolledList, enrolled_of(store, site), lambda row: row.robot)


@router.post("/v1/sites/{site}/enrolled", response_class=Response)
def enrol_robot(service: p.Service, sender: Sender, site: p.Site, act: views.EnrolAct) -> Response:
    """Admit a robot to the bus: the answer is its bundle for `locclient enrol`, a secret until it is used, once, within a day."""
    register, bus = RobotRegister(service.store), service.bus
    with refused_with(422):
        if act.endpoint is None:  # an open bus knows its port
            own = bus.endpoint if bus is not None and has_tls(bus.endpoint) else LISTENING
            endpoint = register.default_endpoint(own)
        else:
            endpoint = check_endpoint(act.endpoint)
    made = register.enrol(site, [act.robot], endpoint, actor=sender.of(act))
    headers = {"Content-Disposition": f'attachment; filename="{act.robot}.fleetmap"', **_ONCE}
    return Response(made[act.robot], media_type="application/octet-stream", headers=headers)


@router.post("/v1/sites/{site}/enrolled/{robot}/revoke")
def revoke_robot(store: p.Store, sender: Sender, site: p.Site, robot: p.Robot, act: views.Act) -> views.ServiceState:
    """Remove a robot, such as a stolen one, from the bus within two seconds."""
    if not RobotRegister(store).revoke(site, [robot], actor=sender.of(act)):
        raise HTTPException(
            404, f"site {site} has not enrolled {robot}; GET /v1/sites/{site}/enrolled lists its robots"
        )
    return views.OK


@router.post("/v1/sites/{site}/robots/{robot}/remove")
def remove_robot(store: p.Store, sender: Sender, site: p.Site, robot: p.Robot, act: views.Act) -> views.ServiceState:
    """Remove a robot from lists within seconds; its counts and failures stay. If it reports again, it is added again."""
    if not store.remove_robots(site, [robot], actor=sender.of(act)):
        raise HTTPException(404, f"site {site} knows no robot {robot}; GET /v1/robots?site={site} lists them")
    return views.OK
