"""The OpenAPI document: FastAPI's own, with problem documents instead of its validation errors, and examples."""

from dataclasses import asdict
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from mapserver.api.views import Problem
from mapserver.fleet_statistics.kpis import Counters, kpis
from mapserver.store import FailureRow

_PARAMETER_EXAMPLES: dict[str, Any] = {
    "site": "hall", "version": 3, "before": 2, "after": 3, "job": 17, "sha256": "5e" * 32, "limit": 100,
    "number": 12, "place": 1, "hours": 24, "by": "version",
}  # fmt: skip
_VERSION = {
    "site": "hall",
    "version": 3,
    "state": "current",
    "parent": 2,
    "created": "2026-01-02T03:04:05Z",
    "manifest_sha256": "ab" * 32,
    "tiles": 42,
    "landmarks": 80412,
    "map_bytes": 1830220,
    "vocabulary_sha256": "cd" * 32,
    "vocabulary_bytes": 512000,
}
_SITE = {"site": "hall", "current_version": 3, "versions": 3, "vocabulary_sha256": "cd" * 32}
_EVENT = {
    "id": 7, "stamp_ns": 1767323045000000000, "site": "hall", "kind": "promoted",
    "detail": "version 2, replacing 3", "version": 2, "actor": "ada", "reason": "robots lose themselves in aisle 3",
}  # fmt: skip
_JOB = {
    "id": 17, "site": "hall", "kind": "nightly", "state": "done", "started": "2026-01-02T01:00:00Z",
    "finished": "2026-01-02T01:40:00Z", "message": "version 3 is published", "report": {},
}  # fmt: skip
_FAILURE = asdict(
    FailureRow(
        number=12, site="hall", robot="tug-7", failure_id="3f9a", received_ns=1767323049000000000,
        happened_ns=1767323045000000000, duration_s=3.5, kind="blind", cause="dark", status="LOST", version=3, tile="4,-1",
        x_map_m=70.2, y_map_m=-3.1,
    )
)  # fmt: skip
_KPIS = asdict(
    kpis(
        Counters(
            reports=57000, observed_ms=57_000_000, driving_ms=40_000_000, after_fix_ms=56_000_000, localised_ms=55_000_000,
            usable_ms=55_500_000, first_fixes=3, first_fix_ms=9000, failures=1, blind_failures=1, blind_seen=1,
        )
    )
)  # fmt: skip
_ANSWER_EXAMPLES: dict[str, Any] = {
    "/v1/failures": {"failures": [_FAILURE], "next": None},
    "/v1/failures/{number}": {"failure": _FAILURE, "report": {"sharpness": 0.4}, "pictures": []},
    "/v1/fleet/measures": {
        "by": "robot",
        "measures": [{"site": "hall", "key": "tug-7", "measures": _KPIS}],
        "next": None,
    },
    "/v1/sites/{site}/hours": {"hours": [{"hour_ns": 1767322800000000000, "measures": _KPIS}], "next": None},
    "/v1/sites": {"sites": [_SITE], "next": None},
    "/v1/sites/{site}/versions": {"versions": [_VERSION], "next": None},
    "/v1/sites/{site}/current": _VERSION,
    "/v1/sites/{site}/events": {"events": [_EVENT], "next": None},
    "/v1/sites/{site}/rollback": _VERSION | {"version": 2, "parent": 1},
    "/v1/sites/{site}/versions/{version}/promote": _VERSION,
    "/v1/sites/{site}/versions/{version}/publish": _VERSION,
    "/v1/jobs": {"jobs": [_JOB], "next": None},
    "/v1/jobs/{job}": _JOB,
    "/healthz": {"status": "ok"},
    "/readyz": {"status": "ok"},
}


def install(app: FastAPI) -> None:
    """Gives `app` its document, made at the first question."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _described(app)
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]


def _described(app: FastAPI) -> dict[str, Any]:
    found = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
    schemas = found["components"]["schemas"]
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    schemas["Problem"] = Problem.model_json_schema()
    found["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    for path, operations in found["paths"].items():
        for method, operation in operations.items():
            operation["responses"].pop("422", None)  # one of 4XX
            for parameter in operation.get("parameters", []):
                if parameter["name"] in _PARAMETER_EXAMPLES:
                    parameter["example"] = _PARAMETER_EXAMPLES[parameter["name"]]
            answer = operation["responses"].get("200", {}).get("content", {}).get("application/json")
            if answer is not None and path in _ANSWER_EXAMPLES:
                answer["example"] = _ANSWER_EXAMPLES[path]
            if method == "post":
                operation["security"] = [{}, {"token": []}]
    return found
