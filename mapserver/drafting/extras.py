"""What plug-ins make beside the tiles of a draft, from its surveys at their final poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from fleetmap.mapformat.manifest import Manifest
from mapserver.drafting.area_corrections import AreaCorrections
from mapserver.drafting.draft_evidence import MappedSession
from mapserver.store import MapStore
from mapserver.survey.settings import SurveySettings


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
