"""What stands in the paths and questions of the API."""

from typing import Annotated

from fastapi import Path, Query

from fleetmap.mapformat.names import NAME_PATTERN, SHA256_PATTERN

Site = Annotated[str, Path(pattern=NAME_PATTERN)]
SiteFilter = Annotated[str | None, Query(pattern=NAME_PATTERN, description="of this site alone")]
Version = Annotated[int, Path(ge=1, le=1 << 31)]
Sha256 = Annotated[str, Path(pattern=SHA256_PATTERN)]
