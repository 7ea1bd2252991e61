"""The OpenAPI document: FastAPI's own, with problem documents for its validation errors; and the JSON of answers.

Stamps keep all digits: nanoseconds since 1970 exceed 2^53, above which programs that use doubles round.
"""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse

from mapserver.api.views import Problem


class ExactJson(JSONResponse):
    """An answer whose fields `..._ns` are decimal numbers in strings."""

    def render(self, content: Any) -> bytes:
        return super().render(_exact(content))


def _exact(value: Any) -> Any:
    if isinstance(value, dict):
        # The type is that of an integer, and not of a bool
        return {k: str(v) if type(v) is int and str(k).endswith("_ns") else _exact(v) for k, v in value.items()}
    return [_exact(item) for item in value] if isinstance(value, list) else value


def install(app: FastAPI) -> None:
    """Install the OpenAPI document in `app`; it is built at the first request."""

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
            if path not in ("/healthz", "/readyz"):
                operation["security"] = [{}, {"token": []}, {"session": []}]
    _describe_stamps(found)
    return found


def _describe_stamps(schema: Any) -> None:
    """Describe stamps as strings in the document, in place."""
    if isinstance(schema, list):
        for item in schema:
            _describe_stamps(item)
    elif isinstance(schema, dict):
        for name, value in schema.items():
            if isinstance(name, str) and name.endswith("_ns") and isinstance(value, dict):
                for kind in (value, *value.get("anyOf", ())):
                    if kind.get("type") == "integer":
                        kind.update(type="string", pattern=r"^-?[0-9]+$")
            else:
                _describe_stamps(value)
