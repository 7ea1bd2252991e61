"""`mapserver map`: what a version knows of how its site looks, for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import Group
from fleetmap.errors import UsageError, disk_errors
from mapserver.commands.options import SiteName, StoreFolder, check_output


def splats(
    version: Annotated[int, typer.Argument(min=1, help="Version that was built with [survey] surfel_map.")],
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File to write, .ply or .spz; replaced if it exists.")],
    site: SiteName,
    store: StoreFolder,
) -> None:
    """Write the surfels of a version as 3D Gaussians, in the frame of the map, for viewers of Gaussian splats."""
    check_output("FILE", file)
    if file.suffix not in (".ply", ".spz"):
        raise UsageError(f"{file} must end in .ply or .spz")
    from mapserver.store import MapStore
    from mapserver.surfels.splat_file import Splats, splat_ply, splat_spz
    from mapserver.surfels.surfel_map import surfels_of

    with MapStore.open(store, read_only=True) as maps:
        surfels = surfels_of(maps.manifest(site, version), maps.blob)
    data = (splat_spz if file.suffix == ".spz" else splat_ply)(Splats.of(surfels))
    with disk_errors(f"{file} cannot be written", "choose another place"):
        file.write_bytes(data)
    typer.echo(f"site {site}: {len(surfels)} surfels of version {version} are in {file}, {len(data) / 1e6:.1f} MB")


MAP = Group("What a version knows of how its site looks.", {"splats": splats})
