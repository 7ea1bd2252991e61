"""`mapserver align`: the pose of a site's map in the drawing of its building."""

from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import expand_options
from fleetmap.errors import UsageError
from mapserver.commands.options import ActorOptions, Json, SiteOptions, open_store, print_json

if TYPE_CHECKING:
    from fleetmap.geometry import Array
    from mapserver.floor_plan.alignment import Alignment
    from mapserver.store import MapStore


@expand_options
def align(
    *,
    where: SiteOptions,
    plan: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Drawing of the building from above, a picture.")
    ] = None,
    pin: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=PX,PY:X,Y", help="Point of the plan (pixels) and of the map (metres); repeat it."),
    ] = None,
    metres_per_pixel: Annotated[
        float | None, typer.Option(min=1e-6, max=1e3, help="Scale of the plan; default: estimated from the pins.")
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="Print the stored alignment; change nothing.")] = False,
    level: Annotated[str, typer.Option(metavar="NAME", help="Name of the level for Open-RMF.")] = "L1",
    json: Json = False,
    by: ActorOptions,
    forget: Annotated[bool, typer.Option("--forget", help="Forget the alignment and the plan.")] = False,
) -> None:
    """Estimate the pose of the map in the building's drawing, and store it; robots get it with the signed list."""
    from fleetmap.mapformat.building import ALIGNMENT
    from mapserver.floor_plan.alignment import PLAN, encode_alignment

    named = plan is not None or bool(pin)
    if show + forget + named != 1:
        raise UsageError("name --pin (and --plan) to align, --show to print the stored alignment, or --forget")
    with open_store(where.store, read_only=show) as maps:
        corners = _corners(maps, where.site)
        if forget:
            maps.keep_site_files(where.site, {ALIGNMENT: None, PLAN: None}, "forgotten", actor=by.named())
            typer.echo(f"site {where.site}: the alignment is forgotten; robots use the alignment of their version")
            return
        if named:
            found, data = _aligned(plan, pin or [], metres_per_pixel, corners)
            files = {ALIGNMENT: encode_alignment(found), PLAN: data}
            maps.keep_site_files(where.site, files, _words(found), actor=by.named())
        alignment = maps.alignment(where.site)
    if alignment is None:
        raise UsageError(f"site {where.site} is not aligned; `mapserver align --plan FILE --pin ...` does it")
    if json:
        print_json(alignment)
    else:
        _print(alignment, corners, level)


def _corners(maps: "MapStore", site: str) -> "Array":
    """Corners of the current version. Its frame is that of the pins; a first draft has its own frame."""
    from mapserver.floor_plan.alignment import map_corners_m

    current = maps.current(site)
    if current is None:
        raise UsageError(f"site {site} has no current version to align; publish one first")
    return map_corners_m(maps.manifest(site, current.version))


def _aligned(
    file: Path | None, given: list[str], metres_per_pixel: float | None, corners: "Array"
) -> "tuple[Alignment, bytes | None]":
    from mapserver.floor_plan.alignment import Alignment
    from mapserver.floor_plan.pins import fit_pins, parse_pin
    from mapserver.floor_plan.plan_file import read_plan, upwards

    pins = [parse_pin(text) for text in given]
    plan = None if file is None else read_plan(file)
    pins = upwards(pins) if plan is None else plan.drawn(pins)
    name, data = (None, None) if plan is None else (plan.name, plan.data)
    fit = fit_pins(pins, metres_per_pixel, corners)
    if not fit.is_checked:
        typer.echo(
            "note: the pins lie on one line and cannot reveal a mirrored plan; add a pin beside the line", err=True
        )
    typer.echo(f"at the far end of the map positions in the building are known to {2 * fit.far_sigma_m:.2f} m (95 %)")
    return Alignment(
        frame=fit.frame, metres_per_unit=fit.metres_per_unit, method="pins", plan=name, off_m=fit.off_m
    ), data


def _words(found: "Alignment") -> str:
    frame = found.frame
    turned = f"turned by {degrees(frame.yaw_rad):.3f} degrees +- {degrees(frame.sigma_rad):.3f}"
    at = f"the map's origin at {frame.x_m:.3f}, {frame.y_m:.3f} m of the building"
    return f"by {found.method}: {at}, {turned}, {found.metres_per_unit:.6g} m per unit of the plan"


def _print(found: "Alignment", corners: "Array", level: str) -> None:
    from mapserver.floor_plan.alignment import reference_coordinates

    typer.echo(_words(found))
    for name, off_m in found.off_m.items():
        typer.echo(f"pin {name}: {off_m:.3f} m left")
    frame = found.frame
    typer.echo(f"\n# Open-RMF, fleet adapter\n{reference_coordinates(frame, level, corners)}")
    typer.echo("\n# ROS 2: building -> map, if no robot publishes it")
    numbers = f"--x {frame.x_m:.4f} --y {frame.y_m:.4f} --yaw {frame.yaw_rad:.6f}"
    typer.echo(f"ros2 run tf2_ros static_transform_publisher {numbers} --frame-id building --child-frame-id map")
