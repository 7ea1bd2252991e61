"""`mapserver align`: the pose of a site's map in the drawing of its building."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import expand_options
from fleetmap.errors import UsageError
from mapserver.commands.options import ActorOptions, Json, SiteOptions, open_store, print_json

if TYPE_CHECKING:
    from fleetmap.geometry import Array
    from mapserver.floor_plan.alignment import Alignment


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
    level: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Name of the level for Open-RMF; default: the building's, else L1."),
    ] = None,
    json: Json = False,
    by: ActorOptions,
    forget: Annotated[bool, typer.Option("--forget", help="Forget the alignment and the plan.")] = False,
) -> None:
    """Estimate the pose of the map in the building's drawing, and store it; robots get it with the signed list."""
    from mapserver.fleet import building
    from mapserver.floor_plan.pins import parse_pin
    from mapserver.floor_plan.plan_file import read_plan

    named = plan is not None or bool(pin)
    if show + forget + named != 1:
        raise UsageError("name --pin (and --plan) to align, --show to print the stored alignment, or --forget")
    with open_store(where.store, read_only=show) as maps:
        corners = building.current_corners_m(maps, where.site)
        if forget:
            building.forget_alignment(maps, where.site, by.named())
            typer.echo(f"site {where.site}: the alignment is forgotten; robots use the alignment of their version")
            return
        if named:
            pins, drawing = [parse_pin(text) for text in pin or []], None if plan is None else read_plan(plan)
            _, fit = building.align(maps, where.site, pins, drawing, metres_per_pixel, by.named())
            if not fit.is_checked:
                words = "the pins lie on one line and cannot reveal a mirrored plan; add a pin beside the line"
                typer.echo(f"note: {words}", err=True)
            off_m = 2 * fit.far_sigma_m
            typer.echo(f"at the far end of the map positions in the building are known to {off_m:.2f} m (95 %)")
        alignment, tower = maps.alignment(where.site), maps.building(where.site)
    if level is None:
        levels = {} if tower is None else {floor.site: floor.level for floor in tower.floors}
        level = levels.get(where.site, "L1")
    if alignment is None:
        raise UsageError(f"site {where.site} is not aligned; `mapserver align --plan FILE --pin ...` does it")
    if json:
        print_json(alignment)
    else:
        _print(alignment, corners, level)


def _print(found: "Alignment", corners: "Array", level: str) -> None:
    from mapserver.fleet.building import alignment_words
    from mapserver.floor_plan.alignment import reference_coordinates

    typer.echo(alignment_words(found))
    for name, off_m in found.off_m.items():
        typer.echo(f"pin {name}: {off_m:.3f} m left")
    frame = found.frame
    typer.echo(f"\n# Open-RMF, fleet adapter\n{reference_coordinates(frame, level, corners)}")
    typer.echo("\n# ROS 2: building -> map, if no robot publishes it")
    numbers = f"--x {frame.x_m:.4f} --y {frame.y_m:.4f} --yaw {frame.yaw_rad:.6f}"
    typer.echo(f"ros2 run tf2_ros static_transform_publisher {numbers} --frame-id building --child-frame-id map")
