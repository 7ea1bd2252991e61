"""Localization of camera robots in the maps of their fleet.

Localize a whole recording, as `locclient replay` does:

    from locclient import localize

    result = localize("drive.mcap", "maps", "hall")  # or "tcp/127.0.0.1:7447" for a server
    result.report["localised_share_of_all"], result.map_from_body, result.statuses
    result.save_picture("drive.png")

`Localizer` takes samples one by one and returns an `Estimate` for each frame; `Robot` adds failure detection and map updates.

Relocalize a single frame, without odometry or history:

    from locclient import LocalizerSettings, MapView, Relocalizer, fetch_map, finished

    loaded, settings = fetch_map("maps", "hall"), LocalizerSettings().relocalizer
    view = MapView(loaded.tiles.values(), loaded.vocabulary, loaded.manifest.camera.focal_px)
    relocalizer = Relocalizer(view, rectifier.camera, settings)
    fixes = finished(relocalizer.anywhere(finished(relocalizer.extract(rectifier.rectify(frame)))))

`fixes` are the verified places, the best first; fixes[0].map_from_cam is (4, 4). Several fixes with similar support mean that the
place is ambiguous, as between identical racks.
"""

from typing import TYPE_CHECKING

from fleetmap.lazy_names import lazy_names

if TYPE_CHECKING:
    from fleetmap.relocalization.map_view import MapView
    from fleetmap.relocalization.relocalizer import Fix, Relocalizer
    from fleetmap.time_sliced import finished
    from fleetmap.version import __version__
    from locclient.localization.estimate import Estimate
    from locclient.localization.localizer import Localizer
    from locclient.localization.settings import LocalizerSettings
    from locclient.replay.replay import LocalizeOptions, fetch_map, localize
    from locclient.replay.run_result import ReplayResult
    from locclient.robot.robot import Robot

__all__ = [
    "Estimate",
    "Fix",
    "LocalizeOptions",
    "Localizer",
    "LocalizerSettings",
    "MapView",
    "Relocalizer",
    "ReplayResult",
    "Robot",
    "__version__",
    "fetch_map",
    "finished",
    "localize",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "fleetmap.version": "__version__",
        "fleetmap.time_sliced": "finished",
        "fleetmap.relocalization.map_view": "MapView",
        "fleetmap.relocalization.relocalizer": "Fix Relocalizer",
        "locclient.localization.estimate": "Estimate",
        "locclient.localization.localizer": "Localizer",
        "locclient.localization.settings": "LocalizerSettings",
        "locclient.replay.replay": "LocalizeOptions fetch_map localize",
        "locclient.replay.run_result": "ReplayResult",
        "locclient.robot.robot": "Robot",
    },
)
