"""`mapserver grid`: the planner grid of a version, as map_server files."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import Group
from fleetmap.errors import disk_errors
from mapserver.commands.options import SiteName, StoreFolder, check_output, open_store, version_named

RobotHeight = Annotated[
    float, typer.Option(metavar="METRES", help="Height of the tallest robot: higher objects are not obstacles.")
]


def export(
    file: Annotated[
        Path, typer.Argument(metavar="OUT.yaml", help="File to write; its image OUT.pgm is written beside it.")
    ],
    site: SiteName,
    store: StoreFolder,
    version: Annotated[int | None, typer.Option(min=1, help="Version; default: the current one.")] = None,
    robot_height: RobotHeight = 1.1,
    heights: Annotated[
        Path | None,
        typer.Option(metavar="FILE.npz", help="Write the lowest and highest surface of each cell to this file, too."),
    ] = None,
) -> None:
    """Write the occupancy grid of a version for nav2's map_server, in the robots' map frame."""
    check_output("OUT.yaml", file, ".yaml")
    check_output("--heights", heights)
    import numpy as np

    from fleetmap.mapformat.grid_tile import CELL_M
    from fleetmap.occupancy_grid import FREE, OCCUPIED, write_grid
    from fleetmap.version_grid import grid_of, occupancy
    from mapserver.plugins.dense_maps.site_grid import area_m2, height_map

    with open_store(store, read_only=True) as maps:
        version = version_named(maps, site, version)
        tiles = grid_of(maps.manifest(site, version), maps.blob)
    grid = occupancy(tiles, robot_height)
    write_grid(file, grid)
    if heights is not None:
        (lowest, highest), where = height_map(tiles)
        arrays = {
            "lowest_m": lowest,
            "highest_m": highest,
            "corner_map_m": where.map_from_grid[:2, 3],
            "cell_m": CELL_M,
        }
        with disk_errors(f"{heights} cannot be written", "choose another place"), heights.open("wb") as stream:
            np.savez_compressed(stream, **arrays)
    rows, columns = grid.cells.shape
    typer.echo(
        f"site {site}: grid of version {version} is in {file}: {columns} x {rows} cells of {grid.resolution_m} m, "
        f"{area_m2(grid, FREE):.1f} m2 free, {area_m2(grid, OCCUPIED):.1f} m2 occupied"
    )


GRID = Group("Planner grid of a version.", {"export": export})
