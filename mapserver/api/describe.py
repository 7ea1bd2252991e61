"""The OpenAPI document: FastAPI's own, with problem documents for its validation errors, and with examples."""

from dataclasses import asdict
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from mapserver.api.exact_json import describe_stamps
from mapserver.api.views import Problem
from mapserver.fleet_statistics.kpis import Counters, kpis
from mapserver.store import Event, FailureRow, JobInfo, SiteInfo

_NOW_NS = 1_767_323_045_000_000_000
_SITE = asdict(SiteInfo("hall", 3, 3))
_VERSION = {
    **{"site": "hall", "version": 3, "state": "current", "parent": 2, "created": "2026-01-02T03:04:05Z"},
    **{"manifest_sha256": "ab" * 32, "tiles": 42, "landmarks": 80412, "map_bytes": 1830220},
    **{"vocabulary_sha256": "cd" * 32, "vocabulary_bytes": 512000},
}
_REASON = "robots lose themselves in aisle 3"
_EVENT = asdict(Event(7, _NOW_NS, "hall", "promoted", "version 2, replacing 3", 2, "ada", _REASON))
_NIGHT = ("2026-01-02T01:00:00Z", "2026-01-02T01:40:00Z", "version 3 is published")
_JOB = asdict(JobInfo(17, "hall", "nightly", "done", *_NIGHT, {}))
_WHERE = (3, "4,-1", 70.2, -3.1)
_FAILURE = asdict(FailureRow(12, "hall", "tug-7", "3f9a", _NOW_NS + 4, _NOW_NS, 3.5, "blind", "dark", "LOST", *_WHERE))
_KPIS = asdict(kpis(Counters(57_000, 57_000_000, 40_000_000, 56_000_000, 55_000_000, 55_500_000, 3, 9000, failures=1)))
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
    """Gives `app` its document, made when it is first asked for."""

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
    found["components"]["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer"},
        "session": {"type": "apiKey", "in": "cookie", "name": "__Host-fleetmap"},
    }
    for path, operations in found["paths"].items():
        for operation in operations.values():
            operation["responses"].pop("422", None)  # one of 4XX
            answer = operation["responses"].get("200", {}).get("content", {}).get("application/json")
            if answer is not None and path in _ANSWER_EXAMPLES:
                answer["example"] = _ANSWER_EXAMPLES[path]
            if path not in ("/healthz", "/readyz"):
                operation["security"] = [{}, {"token": []}, {"session": []}]
    describe_stamps(found)
    return found
