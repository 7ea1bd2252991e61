"""Endpoints of operators, enrolled robots and the log. The guard requires the rights `operators` and `robots`, also for reading."""

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query

from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.operators.operators import Operators
from mapserver.store import AuditLine, MapStore
from mapserver.trust.enrolment import EnrolledRobot, RobotRegister

router = APIRouter()
Person = Annotated[str | None, Query(max_length=200, description="what this person did alone", examples=["ada"])]
Kind = Annotated[str | None, Query(max_length=64, description="kinds that begin so", examples=["robot enrolled"])]


def operators_of(store: MapStore) -> list[views.OperatorView]:
    """Return operators and programs with their valid tokens, by name."""
    tokens: dict[str, list[views.TokenView]] = {}
    for token in store.operators.tokens(store.now_ns()):
        view = views.TokenView(number=token.sha256[:12], scopes=token.scopes.split(), ends_ns=token.ends_ns)
        tokens.setdefault(token.name, []).append(view)
    return [
        views.OperatorView.model_validate(asdict(row) | {"tokens": tokens.get(row.name, [])})
        for row in Operators(store).all()
    ]


def enrolled_of(store: MapStore, site: str) -> list[EnrolledRobot]:
    """Return the enrolled robots of a site, by name."""
    return [entry.shown(store.now_ns()) for entry in RobotRegister(store).robots(site)]


@router.get("/v1/operators")
def list_operators(store: p.Store, page: p.NamePage) -> views.Page[views.OperatorView]:
    """Operators and programs by name, with their sessions and tokens."""
    return page.of(operators_of(store), lambda operator: operator.name)


@router.get("/v1/log")
def log(
    store: p.Store,
    page: p.NumberPage,
    within: p.TimeRange,
    person: Person = None,
    site: p.SiteFilter = None,
    kind: Kind = None,
) -> views.Page[AuditLine]:
    """What people did, the last first: who, what, where, when and why."""
    asked = {"site": site, "person": person, "kind": kind}
    lines = store.log(**asked, of_people=True, span_ns=within, before=page.cursor, limit=page.limit + 1)
    return page.of(lines, lambda line: line.id)


@router.get("/v1/sites/{site}/enrolled")
def enrolled_robots(store: p.Store, site: p.Site, page: p.NamePage) -> views.Page[EnrolledRobot]:
    """Robots of a site that are admitted to the bus, with the days until their certificates end."""
    return page.of(enrolled_of(store, site), lambda row: row.robot)
