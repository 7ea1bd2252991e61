"""What stands in the paths and questions of the API."""

from typing import Annotated, Literal

from fastapi import Path, Query

from fleetmap.mapformat.names import NAME_PATTERN, SHA256_PATTERN

Site = Annotated[str, Path(pattern=NAME_PATTERN)]
SiteFilter = Annotated[str | None, Query(pattern=NAME_PATTERN, description="of this site alone")]
Version = Annotated[int, Path(ge=1, le=1 << 31)]
Sha256 = Annotated[str, Path(pattern=SHA256_PATTERN)]
Axis = Annotated[Literal["site", "robot", "version", "tile", "cause"], Query(description="what the figures are for")]
Hours = Annotated[int, Query(ge=1, le=24 * 400, description="so many hours back, the running one included")]
KeyFilter = Annotated[
    str | None, Query(max_length=64, description="this robot, version, tile or cause alone", examples=[None])
]
FailureNumber = Annotated[int, Path(ge=1, le=1 << 62)]
