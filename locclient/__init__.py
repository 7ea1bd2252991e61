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
    from fleetmap.relocalization.map_view import MapView as MapView
    from fleetmap.relocalization.relocalizer import Fix as Fix
    from fleetmap.relocalization.relocalizer import Relocalizer as Relocalizer
    from fleetmap.time_sliced import finished as finished
    from fleetmap.version import __version__ as __version__
    from locclient.localization.estimate import Estimate as Estimate
    from locclient.localization.localizer import Localizer as Localizer
    from locclient.localization.settings import LocalizerSettings as LocalizerSettings
    from locclient.replay.replay import LocalizeOptions as LocalizeOptions
    from locclient.replay.replay import fetch_map as fetch_map
    from locclient.replay.replay import localize as localize
    from locclient.replay.run_result import ReplayResult as ReplayResult
    from locclient.robot.robot import Robot as Robot

_NAMES = {
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
}
__all__, __getattr__, __dir__ = lazy_names(__name__, _NAMES)
