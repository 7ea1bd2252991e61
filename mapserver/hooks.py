"""Hooks of the map server: what plug-ins add to it. Each registers a function by an entry point in a hook's group; nothing else imports it.

* `mapserver.alerts`, by the setting of `[alerts]` that names a receiver: opens it, of `AlertSettings` (`fleet/alerts.py`), with `host`,
  `tell` (of alerts, acts), `test` and `close`
* `mapserver.commands`, by the command: a function as those of `COMMANDS` in `cli.py`, in a module that is quick to import
* `mapserver.databases`, by the scheme of a URL, or `other`: opens the `Database` (`store/database.py`) there; of the URL, the clock in
  nanoseconds, and `create`: make its tables
* `mapserver.executors`, by the scheme of a scheduler's address, or `other`: opens, for a block, its `Executor` (`survey/executor.py`)
* `mapserver.failure_exports`, by `--format` of `mapserver fleet export`: a function as `write_json_lines` in `fleet/exports.py`
* `mapserver.objects`, by the scheme of a URL, or `other`: opens the `Objects` (`store/blobs.py`) there
* `mapserver.parts`, by the plug-in: adds pages, endpoints and messages of the bus to a `Host` (`dashboard/install.py`) that opens
* `mapserver.poses`, by `trajectory`: opens the `StartPoses` (`drafting/survey_recordings.py`) of `mapserver build`; of the options
  --trajectory, -frame and -scale
* `mapserver.routes`, by the plug-in: adds endpoints to the application, a FastAPI, over an open `MapStore`; of them and an `OfferedFile`
* `mapserver.stages`, by the plug-in: makes more of the surveys of a `ChosenDraft` than tiles, each `Extra` by the key of its report
  (`drafting/extras.py`)
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fleetmap.hooks import plugin, plugins

if TYPE_CHECKING:
    from fleetmap.mapformat.version_file import ExportHead

OfferedFile = Callable[[str, int], tuple["ExportHead", bytes]]
"""Head and SHA-256 of the file of a published version, by site and number; FleetmapError as `GET .../file`."""


def open_url(group: str, url: str, what: str) -> Any:
    """Return what opens URLs of this scheme, by a hook; UsageError if nothing does."""
    scheme = url.partition("://")[0]
    return plugin(group, scheme if scheme in plugins(group) else "other", f"{what} under {scheme}://")
