"""Small pictures of the surveys, kept beside a version: an index, and a JPEG for each (docs/map_format.md)."""

from collections.abc import Callable
from typing import Annotated

import msgspec

from fleetmap.encoding import decode_json
from fleetmap.errors import NewerFormatError, StateError
from fleetmap.mapformat.manifest import Manifest, Positive, Sha256, manifest_entry

PICTURES_KEY = "pictures"
"""Key in `report` of a manifest with the index; older readers ignore it."""

MOST = 1 << 16
_FORMAT = 1
_Triple = Annotated[tuple[float, ...], msgspec.Meta(min_length=3, max_length=3)]


class SurveyPicture(msgspec.Struct, frozen=True, kw_only=True):
    """A picture of a survey: position of its camera and unit vector along its axis in `map`, its stamp, the recording, the JPEG's address.

    stamp_ns: of the recording's clock, which may count from another moment than 1970. kept_ns: of the build that kept it first.
    """

    place_map_m: _Triple
    looks_map: _Triple
    stamp_ns: int
    recording: Annotated[str, msgspec.Meta(max_length=400)]
    sha256: Sha256
    bytes: Positive
    kept_ns: int


class PictureIndex(msgspec.Struct, frozen=True, kw_only=True):
    """The pictures of a version, the latest survey's first."""

    format_version: Positive = _FORMAT
    pictures: Annotated[tuple[SurveyPicture, ...], msgspec.Meta(max_length=MOST)] = ()


class PicturesReport(msgspec.Struct, frozen=True, kw_only=True):
    """Entry in the report of a build. sha256: of the index; bytes: of it and the pictures; pictures: their number."""

    sha256: Sha256
    bytes: int
    pictures: int


def pictures_of(manifest: Manifest, blob: Callable[[str], bytes]) -> tuple[SurveyPicture, ...]:
    """Return the pictures of a version. StateError with the reason if it has none, MapFormatError or NewerFormatError for invalid bytes."""
    where = f"version {manifest.version} of site {manifest.site}"
    found = manifest_entry(manifest, "report", PICTURES_KEY, PicturesReport)
    if found is None:
        raise StateError(
            f"{where} keeps no pictures of its surveys: it was built without `survey_pictures` in [survey]"
        )
    index = decode_json(
        blob(found.sha256), PictureIndex, f"{where}: index of pictures: {{}}; it is damaged or of another program"
    )
    if index.format_version != _FORMAT:
        raise NewerFormatError(f"{where}: pictures of format {index.format_version}; update this fleetmap")
    return index.pictures
