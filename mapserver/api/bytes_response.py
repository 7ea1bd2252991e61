"""Immutable bytes over HTTP: ETag, If-None-Match, and one byte range (RFC 9110)."""

import re

from fastapi import Request, Response

from mapserver.api.problems import problem

PICTURE_HEADERS = {"X-Content-Type-Options": "nosniff", "Content-Security-Policy": "default-src 'none'; sandbox"}
"""Headers of pictures from robots: a browser must treat the bytes as a picture only and run nothing in them."""

_RANGE = re.compile(r"^bytes=(\d{0,18})-(\d{0,18})$")


def bytes_response(request: Request, data: bytes, sha256: str, media_type: str, *, immutable: bool) -> Response:
    """Return bytes with the address `sha256`: 200, 206 for a range, 304 if the client has them, or 416.

    immutable: the path itself names the bytes, so caches may keep them forever.
    """
    etag = f'"{sha256}"'
    headers = {
        "ETag": etag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "public, max-age=31536000, immutable" if immutable else "no-cache",
    }
    if is_held(request, etag):
        return Response(status_code=304, headers=headers)
    span = _span(request, etag, len(data))
    if span is None:
        return Response(data, media_type=media_type, headers=headers)
    start, end = span
    if start >= end:
        detail = f"range {request.headers['range']!r} lies outside of {len(data)} bytes"
        return problem(416, detail, request.url.path, {"Content-Range": f"bytes */{len(data)}"})
    headers["Content-Range"] = f"bytes {start}-{end - 1}/{len(data)}"
    return Response(data[start:end], 206, media_type=media_type, headers=headers)


def is_held(request: Request, etag: str) -> bool:
    """True if the client says that it has the bytes of this tag."""
    tags = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return "*" in tags or etag in tags


def _span(request: Request, etag: str, size: int) -> tuple[int, int] | None:
    """Start and end of the requested range (empty when it cannot be satisfied); None for everything.

    Ranges that cannot be parsed and lists of ranges are ignored, as the RFC allows, as is one whose If-Range fails.
    """
    if request.method != "GET" or request.headers.get("if-range", etag) != etag:
        return None
    match = _RANGE.match(request.headers.get("range", "").strip())
    if match is None or not (match[1] or match[2]):
        return None
    if not match[1]:
        return max(0, size - int(match[2])), size
    if match[2] and int(match[2]) < int(match[1]):
        return None
    end = min(size, int(match[2]) + 1) if match[2] else size
    return int(match[1]), end
