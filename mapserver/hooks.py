"""Hooks of the map server: what plug-ins add to it. Each registers by an entry point in a hook's group; nothing else imports it.

| group | registered by the name of | as |
|---|---|---|
| `mapserver.alerts` | the setting of `[alerts]` that names a receiver | `AlertHook` |
| `mapserver.commands` | the command | a function as those of `COMMANDS` in `mapserver/cli.py`, in a module that is quick to import |
| `mapserver.databases` | the scheme of a URL, or `other` | `DatabaseHook` |
| `mapserver.executors` | the scheme of a scheduler's address, or `other` | `ExecutorHook` |
| `mapserver.failure_exports` | `--format` of `mapserver fleet export` | a function as `write_json_lines` in `mapserver/fleet/exports.py` |
| `mapserver.objects` | the scheme of a URL, or `other` | `ObjectsHook` |
| `mapserver.parts` | the plug-in | `PartHook` |
| `mapserver.poses` | `trajectory` | `PosesHook` |
| `mapserver.routes` | the plug-in | `RouteHook` |
| `mapserver.stages` | the plug-in | `StageHook` |
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fleetmap.hooks import plugin, plugins

if TYPE_CHECKING:
    from fleetmap.mapformat.version_file import ExportHead

OfferedFile = Callable[[str, int], tuple["ExportHead", bytes]]
"""Head and SHA-256 of the file of a published version, by site and number; FleetmapError as `GET .../file`."""

RouteHook = Callable[[Any, Any, OfferedFile], None]
"""Adds endpoints to the application, a FastAPI, over an open `MapStore`."""

StageHook = Callable[[Any], dict[str, Any]]
"""Makes more of a draft's surveys than tiles: of a `ChosenDraft` each `Extra` by the key of its report (`mapserver/drafting/extras.py`)."""

AlertHook = Callable[[Any], Any]
"""Opens the receiver that `AlertSettings` name (`mapserver/fleet/alerts.py`), with `host`, `tell` (of alerts, acts), `test`, `close`."""

ObjectsHook = Callable[[str], Any]
"""Opens the `Objects` (`mapserver/store/blobs.py`) under a URL."""

DatabaseHook = Callable[..., Any]
"""Opens the `Database` (`mapserver/store/database.py`) under a URL: of it, the clock in nanoseconds, and `create`: make its tables."""

PosesHook = Callable[..., Any]
"""Opens the `StartPoses` (`mapserver/drafting/survey_recordings.py`) of `mapserver build`: of the options --trajectory, -frame, -scale."""

ExecutorHook = Callable[[str], Any]
"""Opens, for a block, the `Executor` (`mapserver/survey/executor.py`) of a scheduler's address."""

PartHook = Callable[[Any], None]
"""Adds a part to a server that opens: pages, endpoints, messages of its bus; of a `Host` (`mapserver/dashboard/install.py`)."""


def open_url(group: str, url: str, what: str) -> Any:
    """Return what opens URLs of this scheme, by a hook; UsageError if nothing does."""
    scheme = url.partition("://")[0]
    return plugin(group, scheme if scheme in plugins(group) else "other", f"{what} under {scheme}://")
