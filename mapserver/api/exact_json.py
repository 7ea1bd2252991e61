"""JSON in which no stamp loses digits: nanoseconds since 1970 are above 2^53, which programs that count in doubles round."""

from typing import Any

from fastapi.responses import JSONResponse


class ExactJson(JSONResponse):
    """An answer whose fields `..._ns` are decimal numbers in strings."""

    def render(self, content: Any) -> bytes:
        """The bytes."""
        return super().render(_exact(content))


def _exact(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: str(v) if _is_stamp(key, v) else _exact(v) for key, v in value.items()}
    return [_exact(item) for item in value] if isinstance(value, list) else value


def _is_stamp(key: object, value: object) -> bool:
    return isinstance(key, str) and key.endswith("_ns") and isinstance(value, int) and not isinstance(value, bool)


def describe_stamps(schema: Any) -> None:
    """Says the same in an OpenAPI document, in place."""
    if isinstance(schema, list):
        for item in schema:
            describe_stamps(item)
        return
    if not isinstance(schema, dict):
        return
    for name, value in schema.items():
        if _is_stamp(name, value):
            schema[name] = str(value)
        elif isinstance(name, str) and name.endswith("_ns") and isinstance(value, dict):
            for kind in (value, *value.get("anyOf", ())):
                if kind.get("type") == "integer":
                    kind.update(type="string", pattern=r"^-?[0-9]+$")
        else:
            describe_stamps(value)
