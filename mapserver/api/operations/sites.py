"""Operations on a site: its versions, its areas, its robots."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from fleetmap.errors import UsageError, disk_errors
from fleetmap.mapformat.names import NAME_PATTERN
from mapserver.api.operations.operation import Caller, Done, operation
from mapserver.operators.roles import Scope

if TYPE_CHECKING:
    from mapserver.store import MapStore, VersionInfo

_TRUST = "Confirm the calibration although no recording judged it; kept in the manifest; needs --reason."
_FORCE = "Publish although the gate refuses, except beyond hard limits; needs --reason."
Site = Annotated[str, Option(help="Name of the site.")]
Version = Annotated[int, Argument(min=1, metavar="VERSION", help="The version; `versions` lists them.")]
Draft = Annotated[int | None, Option(min=1, help="Draft to publish; default: the newest.")]
Trust = Annotated[bool, Option("--trust-calibration", help=_TRUST)]
Force = Annotated[bool, Option("--force", help=_FORCE)]
Share = Annotated[float | None, {"gt": 0, "lt": 1, "examples": [0.05]}, Option(help="Default: the setting's.")]
FirstShare = Annotated[
    str | None, Option(metavar="SHARE", help="Run it on this share of the robots first, such as 5%.")
]
BackTo = Annotated[int | None, Option(metavar="VERSION", min=1, help="Only if this one becomes current again.")]
Trial = Annotated[int | None, Option(metavar="ID", min=1, help="Only if it ends this canary.")]
AreaName = Annotated[str, Argument(metavar="NAME", help="An area of the site."), {"examples": ["dock"]}]
Correction = Annotated[
    Literal["forget", "never-use", "freeze", "nothing"],
    Argument(metavar="forget|never-use|freeze|nothing", help="What maps do there."),
]
_ROBOT = {"pattern": NAME_PATTERN, "examples": ["tug-7"]}
Robots = Annotated[list[str], Argument(metavar="ROBOT...", help="Names of robots."), _ROBOT]
Endpoint = Annotated[
    str | None,
    {"pattern": r"^(tls|quic)/\S+:[0-9]{1,5}$", "max_length": 300},
    Option(metavar="ENDPOINT", help="Endpoint of the server; default: its certificate's first name."),
]
Bundles = Annotated[Path, Option(metavar="DIR", help="Folder for the bundles ROBOT.fleetmap.")]
Part = Annotated[str, {}]  # of an address alone
_MOST = 1e12  # as fleetmap.encoding, which a command line does not wait for
_NUMBER = {"ge": -_MOST, "le": _MOST, "examples": [1.57]}
Metres = Annotated[float, _NUMBER]
Heading = Annotated[float | None, _NUMBER]
Sigma = Annotated[float, {"gt": 0, "le": 20}]
Corners = Annotated[list[tuple[float, float]], {"min_length": 3, "examples": [[[0, 0], [4, 0], [4, 3]]]}]
of_robots = partial(operation, needs=Scope.ROBOTS)


@operation("/v1/sites/{site}/versions/{version}/publish", "publish", answer="VersionView")
def publish(
    caller: Caller, site: Site, version: Draft = None, trust_calibration: Trust = False, force: Force = False
) -> Done:
    """Check a draft by the gate and make it the current version; status 4 if the gate refuses it."""
    from mapserver import releases

    store, gate = caller.store, caller.config.gate
    published = releases.publish(
        store, site, version, actor=caller.actor, trust_calibration=trust_calibration, force=force, gate=gate
    )
    info = store.version(site, published)
    return Done("\n".join(_published(store, info)), info)


def _published(store: "MapStore", info: "VersionInfo") -> Iterator[str]:
    """What who published a version should know of it."""
    from mapserver.quality.directions import one_way_words
    from mapserver.quality.probes import lookalike_words

    verdict, evidence = store.verdicts(info.site, info.version)[-1], store.evidence(info.site, info.version)
    sizes = f"{info.tiles} tiles, {info.landmarks} landmarks, {info.map_bytes} bytes"
    yield f"site {info.site}: version {info.version} is current ({sizes})"
    yield from (f"published by force although {refused}" for refused in verdict.reasons)
    if verdict.report.get("not_judged"):
        yield f"not judged, evidence missing: {', '.join(verdict.report['not_judged'])}"
    if one_way := one_way_words(() if evidence is None else evidence.directions or ()):
        yield store.areas(info.site).name_tiles(one_way, store.manifest(info.site, info.version).tile_size_m)
    yield from verdict.report.get("warnings", ())
    if alike := lookalike_words(None if evidence is None else evidence.starts):
        yield alike


@operation("/v1/sites/{site}/versions/{version}/promote", "promote", answer="VersionView")
def promote(caller: Caller, version: Version, site: Site, *, canary: FirstShare = None) -> Done:
    """Make VERSION, published before, the current version of its site.

    With --canary some robots run it first (a draft goes through the gate first); the server then promotes it or rolls it back.
    """
    from mapserver import releases

    if canary is not None:
        return start_canary(caller, version, site, _share(canary))
    releases.promote(caller.store, site, version, actor=caller.actor)
    return Done(f"site {site}: version {version} is current", caller.store.version(site, version))


@operation("/v1/sites/{site}/versions/{version}/canary", answer="CanaryView")
def start_canary(caller: Caller, version: Version, site: Site, share: Share = None) -> Done:
    """Let a share of the robots run a version before the others; a draft goes through the gate first.

    `rollback` withdraws it, promoting it ends it early; otherwise the server decides by the failures of both groups.
    """
    from mapserver import releases

    share = caller.config.canary.share if share is None else share
    begun = releases.start_canary(caller.store, site, version, share, actor=caller.actor, gate=caller.config.gate)
    words = (
        f"site {site}: {share:g} of the robots run version {version}, the others stay on {begun.base_version}; "
        "`mapserver serve` judges it, `rollback` withdraws it"
    )
    return Done(words, begun)


def _share(text: str) -> float:
    try:
        share = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        share = 0.0
    if not 0 < share < 1:
        raise UsageError(f"--canary {text!r}: write a share of the robots between 0 and 1, such as 5% or 0.05")
    return share


@operation("/v1/sites/{site}/rollback", "rollback", answer="VersionView")
def rollback(caller: Caller, site: Site, to: BackTo = None, canary: Trial = None) -> Done:
    """Make the previous version current again; the current one retires. A running canary is withdrawn instead."""
    from mapserver import releases

    version = releases.roll_back(caller.store, site, to=to, canary=canary, actor=caller.actor)
    return Done(f"site {site}: version {version} is current again", caller.store.version(site, version))


@operation("/v1/sites/{site}/areas/correct", "areas correct", answer="GeoJson")
def correct_area(caller: Caller, name: AreaName, kind: Correction, site: Site) -> Done:
    """Let an area correct the map, from the next build on, with a reason; `nothing` ends that."""
    from mapserver.fleet.building import correct_area
    from mapserver.floor_plan.areas import CorrectionKind

    correction = None if kind == "nothing" else CorrectionKind(kind)
    areas = correct_area(caller.store, site, name, correction, caller.actor)
    (changed,) = (area for area in areas.areas if area.name == name)
    return Done(f"{name}: {changed.size_m2:.1f} m2{changed.effects}", areas.geojson(site))


@operation("/v1/sites/{site}/areas/undo", "areas undo", answer="GeoJson")
def undo_areas(caller: Caller, site: Site) -> Done:
    """Bring back the areas and corrections as before their last change; once more, and they are as now."""
    from mapserver.fleet.building import undo_areas

    areas = undo_areas(caller.store, site, caller.actor)
    return Done(f"site {site}: {len(areas.names)} areas, as before the last change", areas.geojson(site))


@operation("/v1/sites/{site}/resurvey/requests", answer="Survey")
def request_survey(caller: Caller, site: Site, corners_map_m: Corners) -> Done:
    """Request a survey of a polygon; its tiles stay on the list until the request is closed. The first corner is not repeated."""
    from mapserver.fleet.building import ask_for_survey

    return Done("", ask_for_survey(caller.store, site, corners_map_m, caller.actor))


@operation("/v1/sites/{site}/resurvey/requests/{asked}/end")
def end_survey_request(caller: Caller, site: Site, asked: Part) -> Done:
    """Remove a request from the list because it was surveyed or is no longer wanted."""
    from mapserver.fleet.building import end_request

    end_request(caller.store, site, asked, caller.actor)
    return Done("")


@operation("/v1/sites/{site}/robots/{robot}/initial_pose")
def set_initial_pose(
    caller: Caller,
    site: Site,
    robot: Part,
    x_map_m: Metres,
    y_map_m: Metres,
    heading_rad: Heading = None,
    sigma_m: Sigma = 0.5,
) -> Done:
    """Send an operator's pose to a robot: it overrides the tracked pose until fixes outweigh it. `ok`: the robot was notified.

    Heading from x towards y; sigma: the uncertainty of x and of y.
    """
    from fleetmap.messages import InitialPoseMessage
    from mapserver.serving.bus_service import place_robot

    place: dict[str, Any] = {"x_map_m": x_map_m, "y_map_m": y_map_m, "heading_rad": heading_rad, "sigma_m": sigma_m}
    told = InitialPoseMessage(site=site, robot=robot, **place)
    place_robot(caller.store, caller.served.fleet, caller.served.bus, told, caller.actor)
    return Done("")


@of_robots("/v1/sites/{site}/robots/{robot}/remove", "robots remove")
def remove_robots(caller: Caller, robot: Robots, site: Site) -> Done:
    """Remove robots from lists within seconds; `gc` need not keep their versions any more. Their past counts stay.

    A robot that reports again is added again.
    """
    removed = caller.store.remove_robots(site, robot, actor=caller.actor)
    return _done(robot, removed, site, "removed", "knows no robot")


@of_robots("/v1/sites/{site}/enrolled", "robots enrol", answer="Bundle")
def enrol_robots(
    caller: Caller, robot: Robots, site: Site, endpoint: Endpoint = None, *, out: Bundles = Path()
) -> Done:
    """Allow robots on the bus: makes one bundle per robot for `locclient enrol`, to be used once within a day.

    A bundle is secret until it is used: transfer it on a USB stick or over SSH.
    """
    from fleetmap.bus.endpoints import check_endpoint, has_tls
    from fleetmap.files import write_atomically
    from mapserver.trust.enrolment import LISTENING, RobotRegister

    register, bus = RobotRegister(caller.store), None if caller.served is None else caller.served.bus
    own = bus.endpoint if bus is not None and has_tls(bus.endpoint) else LISTENING  # an open bus knows its port
    reached = register.default_endpoint(own) if endpoint is None else check_endpoint(endpoint)
    if caller.served is not None:
        return Done("", register.enrol(site, robot, reached, actor=caller.actor))
    with disk_errors(f"{out} cannot be written", "name another folder by --out", UsageError):
        out.mkdir(parents=True, exist_ok=True)
        for name, bundle in register.enrol(site, robot, reached, actor=caller.actor).items():
            write_atomically(out / f"{name}.fleetmap", [bundle])
    words = [f"{out / f'{name}.fleetmap'}: for robot {name} of site {site} at {reached}, within 24 h" for name in robot]
    if site not in {info.site for info in caller.store.sites()}:
        words.append(f"note: the store has no map of site {site} yet")
    return Done("\n".join(words))


@of_robots("/v1/sites/{site}/enrolled/{robot}/revoke", "robots revoke")
def revoke_robots(caller: Caller, robot: Robots, site: Site) -> Done:
    """Remove robots, such as stolen ones, from the bus at once; a running server follows within two seconds."""
    from mapserver.trust.enrolment import RobotRegister

    gone = RobotRegister(caller.store).revoke(site, robot, actor=caller.actor)
    return _done(robot, gone, site, "revoked", "has not enrolled")


def _done(asked: list[str], gone: list[str], site: str, done: str, fault: str) -> Done:
    if missing := [robot for robot in asked if robot not in gone]:
        others = f"; the other named robots are {done}" if gone else ""
        raise UsageError(f"site {site} {fault} {', '.join(missing)}, as its lists of robots show{others}")
    return Done("\n".join(f"site {site}: robot {robot} is {done}" for robot in gone))
