"""The library: maps built from recordings, and maps of a store as arrays. Paths are str or Path, errors FleetmapErrors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import StateError, UsageError
from fleetmap.geometry import Array
from fleetmap.mapformat.manifest import Manifest
from fleetmap.mapformat.names import check_name
from fleetmap.mapformat.tile import Tile, decode_tile
from fleetmap.recordings import open_recording
from fleetmap.recordings.sensor_subset import sensor_set_of
from fleetmap.sensors.samples import Trajectory
from mapserver import releases
from mapserver.config import survey_settings
from mapserver.drafting.draft import BuildOptions, BuildRequest, Draft, build_draft, picture_png
from mapserver.drafting.report import BuildResult, write_file
from mapserver.quality.gate import GateSettings
from mapserver.store import NOBODY, Actor, MapStore
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_map import SurveyMap

__all__ = ["Actor", "BuildOptions", "BuiltMap", "GateSettings", "MapArrays", "MapStore", "build_map", "open_map"]
__all__ += ["open_store", "settings_for"]

_NONE: dict[str, NDArray[Any]] = {
    "landmark_ids": np.zeros(0, np.uint32),
    "points_map": np.zeros((0, 3)),
    "descriptors": np.zeros((0, 32), np.uint8),
    "place_ids": np.zeros(0, np.uint32),
    "map_from_cam": np.zeros((0, 4, 4)),
}
"""The arrays of a map without tiles."""


@dataclass(frozen=True)
class BuiltMap(Draft):
    """A built and stored draft: its version in the store, the result as a sentence, its report (the keys of docs/reports.md).

    map: keyframes, landmarks and observations as arrays. left_out: by content hash, the reason why a recording is not in the map.
    """

    store: Path
    site: str
    built: BuildResult

    @property
    def map(self) -> SurveyMap:
        """The survey in the frame `map`."""
        return self.built.joined.map

    @property
    def trajectory(self) -> Trajectory:
        """map_from_body of every selected frame."""
        return self.map.trajectory

    def save_picture(self, path: str | Path) -> None:
        """Draw the map from above as a PNG."""
        write_file(Path(path), picture_png(self.site, self, self.built))

    def publish(
        self,
        *,
        gate: GateSettings | None = None,
        trust_calibration: bool = False,
        force: bool = False,
        actor: Actor = NOBODY,
    ) -> None:
        """Make it the site's current version; GateRefusedError if `gate` refuses it, unless forced.

        A site's first version is refused if its recordings are too short or too straight to judge the calibration. With
        trust_calibration the actor, who needs a name and a reason, confirms it; the manifest records that.
        """
        gate = gate or GateSettings()
        with MapStore.open(self.store) as maps:
            releases.publish(
                maps, self.site, self.version, actor=actor, trust_calibration=trust_calibration, force=force, gate=gate
            )


def build_map(
    recordings: Sequence[str | Path] | str | Path, store: str | Path, site: str, options: BuildOptions | None = None
) -> BuiltMap:
    """Survey the recordings, join them to the site's current version, and store the map as a draft."""
    options = options or BuildOptions()
    paths = (recordings,) if isinstance(recordings, str | Path) else recordings
    if not paths:
        raise UsageError("build_map: no recording is given; name one or more")
    request = BuildRequest(tuple(Path(path) for path in paths), check_name(site, "site"), Path(store), options)
    _need_gtsam()
    with open_recording(request.recordings[0], options.opening) as first:
        request = replace(request, first=first)
        draft, built = build_draft(request, settings_for(request), recorded=True)
    return BuiltMap(draft.version, draft.sentence, draft.report, draft.left_out, request.store, site, built)


def _need_gtsam() -> None:
    """Raise ModuleNotFoundError without gtsam, before a build that would end at its first loop."""
    if find_spec("gtsam") is None:
        raise ModuleNotFoundError("gtsam is not installed", name="gtsam")


def settings_for(request: BuildRequest) -> SurveySettings:
    """Return the survey settings of the request: its own, or the preset of the first recording's sensors, overridden by its file."""
    _need_gtsam()
    options, first = request.options, request.first
    if options.settings is not None:
        return options.settings
    known = options.use or (None if first is None else first.sensor_set)
    return survey_settings(options.config, known or sensor_set_of(request.recordings[0], options.opening))


@dataclass(frozen=True)
class MapArrays:
    """A version of a site in its form for robots: N landmarks and K places (keyframes), tile by tile.

    landmark_ids (N,), points_map (N, 3), descriptors (N, 32) uint8; place_ids (K,), map_from_cam (K, 4, 4).
    """

    site: str
    version: int
    manifest: Manifest
    tiles: tuple[Tile, ...]
    landmark_ids: NDArray[np.uint32]
    points_map: Array
    descriptors: NDArray[np.uint8]
    place_ids: NDArray[np.uint32]
    map_from_cam: Array


def open_store(path: str | Path, *, create: bool = False) -> MapStore:
    """Open the map store in a folder; to be closed, or used in a `with` statement."""
    return MapStore.open(Path(path), create=create)


def open_map(store: str | Path, site: str, version: int | None = None) -> MapArrays:
    """Return the tiles of a version, by default the current one, decoded and concatenated."""
    with open_store(store) as maps:
        if version is None:
            current = maps.current(site)
            if current is None:
                raise StateError(f"site {site} has no published version; name a draft, or publish one")
            version = current.version
        manifest = maps.manifest(site, version)
        tiles = tuple(decode_tile(maps.blob(tile.sha256)) for tile in manifest.tiles)
    joined = {name: np.concatenate([none, *(getattr(tile, name) for tile in tiles)]) for name, none in _NONE.items()}
    return MapArrays(site=site, version=version, manifest=manifest, tiles=tiles, **joined)
