"""Maps and surveys for the pages: all that they read from the store and change in it."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

from fleetmap.errors import FleetmapError, StateError, UsageError
from fleetmap.mapformat import Manifest, decode_tile
from fleetmap.mapformat.building import ALIGNMENT
from fleetmap.messages import FailureReport
from fleetmap.version_grid import known_grid, occupancy
from mapserver import releases
from mapserver.dashboard.map_layers import Box, Layer, Picture, box_of
from mapserver.dashboard.plan import Plan, make_plan
from mapserver.dashboard.space.loops import Loop, loops_of_version
from mapserver.dashboard.space.points import space_bytes
from mapserver.dashboard.underlays import floor_picture, grid_picture
from mapserver.fleet.survey_requests import ask_for_survey, end_request
from mapserver.floor_plan.alignment import PLAN
from mapserver.floor_plan.areas import Areas
from mapserver.floor_plan.survey_requests import SurveyRequest
from mapserver.quality.figures import TrustedCalibration
from mapserver.quality.gate import GateSettings
from mapserver.releases import Difference
from mapserver.serving.expected_views import failure_camera
from mapserver.store import Actor, CanaryRow, Event, JobInfo, MapStore, SiteInfo, VerdictRow, VersionInfo
from mapserver.surfels.surfel_map import index_address

_log = logging.getLogger(__name__)
_CACHED_PLANS = 8
_CACHED_UNDERLAYS = 8
_GRID_HEIGHT_M = 1.1  # as the API's grid without a height
_EVENTS_SHOWN = 50
_JOBS_SHOWN = 100


@dataclass(frozen=True, slots=True)
class VersionQuality:
    """A version with its manifest, the build's report in it, the gate's verdicts, oldest first, and calibrations that a person trusts."""

    info: VersionInfo
    manifest: Manifest
    verdicts: list[VerdictRow]
    trusted: list[TrustedCalibration]


@dataclass(frozen=True, slots=True)
class SiteHistory:
    """Versions and events of a site, newest first. before: target of a rollback, if any; trial: the version on trial, if any."""

    site: SiteInfo
    versions: list[VersionInfo]
    events: list[Event]
    before: int | None
    trial: CanaryRow | None

    @property
    def fingerprint(self) -> tuple[object, ...]:
        """Changes with everything that the page shows."""
        newest = self.events[0].id if self.events else 0
        trial = None if self.trial is None else self.trial.id
        return newest, trial, tuple((info.version, info.state) for info in self.versions)


Span = tuple[int | None, int | None]
"""From when and until before when, nanoseconds since 1970; None: without an end."""
EVER: Span = (None, None)


class MapData:
    """Reads and changes maps in an open store. Methods may be called from any thread; errors are the store's."""

    def __init__(self, store: MapStore, gate: GateSettings, trial_share: float) -> None:
        self._store = store
        self._gate = gate
        self.trial_share = trial_share
        self._plans: OrderedDict[str, Plan] = OrderedDict()
        self._underlays: OrderedDict[tuple[object, ...], tuple[bytes, Box] | None] = OrderedDict()
        self._lock = threading.Lock()

    def sites(self) -> list[str]:
        """Names of all sites."""
        return [info.site for info in self._store.sites()]

    def sites_with_jobs(self) -> list[str]:
        """Sites of which there is a job, also those without any version yet."""
        return self._store.sites_with_jobs()

    def chosen_site(self, site: str | None) -> str:
        """`site`, or the first site if none is named; UsageError for an unknown one."""
        known = self.sites()
        if not known:
            raise UsageError("the store has no site yet; `mapserver build` makes one from a recording")
        if site is not None and site not in known:
            raise UsageError(f"the store has no site {site[:64]}; it has: {', '.join(known)}")
        return site or known[0]

    def history(self, site: str) -> SiteHistory:
        """Versions and the last events of a site."""
        info = next(info for info in self._store.sites() if info.site == site)
        versions = self._store.versions(site)[::-1]
        events = self._store.last_events(site, _EVENTS_SHOWN)
        rows = self._store.releases(site)
        return SiteHistory(info, versions, events, rows.rollback_target, rows.canary)

    def current_version(self, site: str) -> int | None:
        """The number of the current version, None before the first."""
        current = self._store.current(site)
        return None if current is None else current.version

    def has_version(self, site: str, version: int) -> bool:
        """Whether the store has a version."""
        return any(info.version == version for info in self._store.versions(site))

    def quality(self, site: str, version: int) -> VersionQuality:
        """A version with all that was said about it."""
        store, info = self._store, self._store.version(site, version)
        return VersionQuality(info, store.manifest(site, version), store.verdicts(site, version), store.trusted(info))

    def plan(self, site: str, version: int) -> Plan:
        """The plan of a version; the last ones are kept, since versions do not change."""
        sha256 = self._store.version(site, version).manifest_sha256
        with self._lock:  # a second browser waits for the first one's picture instead of making it again
            plan = self._plans.get(sha256)
            if plan is None:
                manifest = self._store.manifest(site, version)
                plan = make_plan(manifest, lambda entry: decode_tile(self._store.blob(entry.sha256)))
                self._plans[sha256] = plan
            self._plans.move_to_end(sha256)
            while len(self._plans) > _CACHED_PLANS:
                self._plans.popitem(last=False)
        return plan

    def space(self, site: str, version: int) -> bytes:
        """A version's landmarks and places for the view in space; made at each call, since browsers keep it."""
        manifest = self._store.manifest(site, version)
        return space_bytes([decode_tile(self._store.blob(entry.sha256)) for entry in manifest.tiles])

    def loops(self, site: str, version: int) -> list[Loop]:
        """Loops of the build that made a version, as far as a job that is kept tells them."""
        return loops_of_version((job.report for job in self._store.jobs(site, limit=_JOBS_SHOWN)), version)

    def underlays(self, site: str, version: int, root: str) -> list[Layer]:
        """The floor plan and the occupancy grid under a version's map, where there are any; root: prefix of their addresses."""
        found = []
        for name, kind in (("Floor plan", "floor"), ("Occupancy grid", "grid")):
            picture = self.underlay(site, version, kind)
            if picture is not None:
                found.append(Layer(name, [Picture(f"{root}/underlays/{site}/{version}/{kind}.png", picture[1])]))
        return found

    def underlay(self, site: str, version: int, kind: str) -> tuple[bytes, Box] | None:
        """A PNG and where it lies, None where the site or version has none or it cannot be drawn, which the log says."""
        key = (
            self._store.version(site, version).manifest_sha256,
            kind,
            *(self._store.site_file_sha256(site, file) for file in (PLAN, ALIGNMENT) if kind == "floor"),
        )
        with self._lock:
            if key in self._underlays:
                return self._underlays[key]
        try:
            made = self._floor(site, version) if kind == "floor" else self._grid(site, version)
        except FleetmapError as error:
            _log.warning("the map of %s is shown without its %s: %s", site, kind, error)
            made = None
        with self._lock:
            self._underlays[key] = made
            while len(self._underlays) > _CACHED_UNDERLAYS:
                self._underlays.popitem(last=False)
        return made

    def _floor(self, site: str, version: int) -> tuple[bytes, Box] | None:
        data, alignment = self._store.site_file(site, PLAN), self._store.alignment(site)
        if data is None or alignment is None:
            return None
        box = box_of(self.plan(site, version))
        return floor_picture(data, alignment, box), box

    def _grid(self, site: str, version: int) -> tuple[bytes, Box] | None:
        tiles = known_grid(self._store.manifest(site, version), self._store.blob)
        return grid_picture(occupancy(tiles, _GRID_HEIGHT_M)) if tiles else None

    def areas(self, site: str) -> Areas:
        """The named areas of a site."""
        return self._store.areas(site)

    def lacks_view(self, report: FailureReport) -> str | None:
        """Why it cannot be drawn what a robot should have seen when its failure began; None where it can."""
        try:
            version, _, _ = failure_camera(report)
            index_address(self._store.manifest(report.site, version))
        except FleetmapError as error:
            return str(error)
        return None

    def lacks_surfels(self, site: str, version: int) -> str | None:
        """Why a version has no map that renders; None where it has one."""
        try:
            index_address(self._store.manifest(site, version))
        except FleetmapError as error:
            return str(error)
        return None

    def difference(self, site: str, before: int, after: int) -> Difference:
        """The difference between two versions."""
        return releases.difference(self._store, site, before, after)

    def changed_tiles(self, site: str, before: int, after: int) -> dict[tuple[int, int], str]:
        """Cells that differ between two versions: added, removed or changed."""
        old, new = (
            {(tile.x, tile.y): tile.sha256 for tile in self._store.manifest(site, version).tiles}
            for version in (before, after)
        )
        changed = {cell: "changed" for cell in old.keys() & new.keys() if old[cell] != new[cell]}
        added, removed = new.keys() - old.keys(), old.keys() - new.keys()
        return changed | dict.fromkeys(added, "added") | dict.fromkeys(removed, "removed")

    def survey_requests(self, site: str) -> list[SurveyRequest]:
        """What people asked to survey again."""
        return self._store.survey_requests(site)

    def ask_for_survey(self, site: str, corners_map_m: Sequence[tuple[float, float]], actor: Actor) -> str:
        """Puts a polygon on the list of the next survey."""
        return f"Survey {ask_for_survey(self._store, site, corners_map_m, actor).id} is on the list."

    def end_survey_request(self, site: str, request: str, actor: Actor) -> str:
        """Takes it off that list."""
        end_request(self._store, site, request, actor)
        return f"Survey {request} is done."

    def jobs(self, site: str, span_ns: Span = EVER) -> list[JobInfo]:
        """The last jobs of a site that began in a time, newest first."""
        return self._store.jobs(site, span_ns, limit=_JOBS_SHOWN)

    def events(self, site: str, span_ns: Span) -> list[Event]:
        """The last that happened to a site in a time, newest first."""
        return self._store.events(site, span_ns)[::-1][:_EVENTS_SHOWN]

    def job(self, number: int) -> JobInfo:
        return self._store.job(number)

    def publish(self, site: str, version: int, actor: Actor) -> str:
        """Takes a draft through the gate and makes it current."""
        releases.publish(self._store, site, version, actor=actor, gate=self._gate)
        return f"Version {version} is published and current."

    def promote(self, site: str, version: int, actor: Actor) -> str:
        """Makes an earlier version current."""
        releases.promote(self._store, site, version, actor=actor)
        return f"Version {version} is current."

    def start_trial(self, site: str, version: int, actor: Actor) -> str:
        releases.start_canary(self._store, site, version, self.trial_share, actor=actor, gate=self._gate)
        return f"Version {version} is tried by {self.trial_share:.0%} of the robots."

    def stop_trial(self, site: str, trial: CanaryRow, actor: Actor) -> str:
        """Ends a trial and retires its version; StateError if it is no longer on trial."""
        outcome = f"taken back by hand: {actor.reason or 'no reason given'}"
        releases.end_canary(self._store, trial, promote=False, outcome=outcome, actor=actor)
        return f"Version {trial.version} of {site} is rolled back."

    def roll_back(self, site: str, version: int, actor: Actor) -> str:
        """Makes the previous version current; StateError if that is no longer `version`."""
        rows = self._store.releases(site)
        if rows.rollback_target != version or rows.canary is not None:
            raise StateError(f"a rollback no longer leads to version {version}; reload the page")
        return f"Version {releases.roll_back(self._store, site, actor=actor)} is current."
