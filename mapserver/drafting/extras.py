"""What plug-ins make beside the tiles of a draft, from its surveys at their final poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from fleetmap.geometry import Array
from fleetmap.mapformat.manifest import Manifest
from mapserver.drafting.area_corrections import AreaCorrections
from mapserver.store import MapStore
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import Survey


class MappedSession(NamedTuple):
    """A recording in the map: its name, its survey, and map_from_body (F, 4, 4) of its frames in the final frame."""

    name: str
    survey: Survey
    map_from_body: Array


@dataclass(frozen=True)
class ChosenDraft:
    """A draft whose tiles are chosen. parent: the version before, None for a first one; maps: the store, with its bytes."""

    sessions: Sequence[MappedSession]
    settings: SurveySettings
    corrections: AreaCorrections
    parent: Manifest | None
    maps: MapStore


class Extra(NamedTuple):
    """Bytes beside the tiles. report: their entry in the build's report and the manifest; kind: one of `EXTRA_TABLES`."""

    report: msgspec.Struct | None
    kind: str
    blobs: Sequence[bytes]
