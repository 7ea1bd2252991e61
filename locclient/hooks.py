"""Hooks of a robot: what plug-ins add to it. Each registers by an entry point in a hook's group; nothing else imports it.

| group | registered by the name of | as |
|---|---|---|
| `locclient.commands` | the command | a function as those of `COMMANDS` in `locclient/cli.py`, in a module that is quick to import |
| `locclient.links` | its section in the configuration file | `LinkHook` |
| `locclient.priors` | its section in the configuration file | `PriorHook` |
| `locclient.sources` | `[source] kind` | a function as those of `SOURCES` in `fleetmap/sources/source.py` |
| `locclient.outputs` | `[output] format` | `OutputHook` |
| `locclient.run_exports` | `locclient replay`'s option | a function of a path that opens a `RunExport` of `locclient/replay/replay.py` |
"""

from collections.abc import Callable, Mapping
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

from fleetmap.config import Section
from fleetmap.mapformat.building import Floor
from fleetmap.messages import WantedVersion
from fleetmap.sensors.samples import PositionPrior
from locclient.identity import MapAddress
from locclient.robot.robot import ImagePriors, Outcome
from locclient.robot.version_trial import VersionChange

if TYPE_CHECKING:
    from fleetmap.bus.zenoh_bus import Bus
    from fleetmap.geometry import Array
    from fleetmap.sensors.calibration import RigCalibration
    from fleetmap.sensors.rectification import MountedCamera
    from fleetmap.sensors.source_settings import Topics
    from fleetmap.sources.intake import Intake
    from locclient.maps.map_client import MapClient
    from locclient.outputs import OutputSection, Publisher


class LinkedRobot(NamedTuple):
    """What a link may use of its robot. lost_radius_m: 95 % radius beyond which a pose is LOST. stop_above_m: protection
    level beyond which the robot must not drive by it.

    client: with the cache, on the thread of `RobotLink.work`; its `trust` is None without a map server. offer: passes a version to the
    localizer.
    """

    client: "MapClient"
    insecure: bool
    lost_radius_m: float
    offer: Callable[[WantedVersion], None]
    put_prior: Callable[[PositionPrior], None]
    stop_above_m: float = inf


class RobotLink(NamedTuple):
    """An open link, as the functions that the daemon calls: `start` and `stop` with its own threads.

    work: what may block, repeatedly on the network's thread. after_frame: the results of a frame, the versions in use, the building, and
    the versions of its other sites' maps; on the localizing thread. silence: once a second while frames are missing.
    changed_version: on the network's thread, after the change on the disk. chooses: who selects the version in place of the map server.
    """

    start: Callable[[], None]
    stop: Callable[[], None]
    work: Callable[[], None]
    after_frame: Callable[[Outcome, frozenset[int], Mapping[str, Floor], Mapping[str, int]], None]
    silence: Callable[[], None]
    changed_version: Callable[[VersionChange], None]
    chooses: str = ""


class LinkHook(NamedTuple):
    """A link of the robot to another system. section: all its keys may be set.

    is_on: whether the section asks for it; the robot may then be without a map server. check: raises UsageError for invalid settings; the
    last argument is [run] insecure. open: called after `check`, for a robot that is not confined to a store's folder.
    """

    section: type[Section]
    is_on: Callable[[Any], bool]
    check: Callable[[Any, MapAddress, bool], None]
    open: Callable[[Any, LinkedRobot], RobotLink]


class OutputHook(NamedTuple):
    """A format of estimates for the robot's own programs. check: raises UsageError for settings of [output] that do not suit [topics].

    open: by the bus at [output] endpoint or the map server's, the names of site and robot, and the rig; the intake receives commands of the
    robot's own programs. Raises UsageError for an invalid topic. needs_bus: not opened without one.
    """

    open: "Callable[[OutputSection, Bus | None, str, str, RigCalibration, Intake], Publisher]"
    check: "Callable[[OutputSection, Topics], None]"
    needs_bus: bool = True


class PriorHook(NamedTuple):
    """What tells a robot its place by its images. section: all its keys may be set.

    open: by the section, the rig's first camera, and base_from_body (4, 4); None if the section does not ask for it. UsageError for
    invalid settings.
    """

    section: type[Section]
    open: "Callable[[Any, MountedCamera, Array], ImagePriors | None]"
