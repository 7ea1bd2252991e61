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


def changes(
    before: Annotated[int, typer.Argument(min=1, help="Version that was built with [survey] surfel_map.")],
    after: Annotated[int, typer.Argument(min=1, help="Another one.")],
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="File to write, .png or .geojson; replaced if it exists.")
    ],
    site: SiteName,
    store: StoreFolder,
) -> None:
    """Write what appeared and what vanished between two versions, as a plan in the frame of the map or as GeoJSON."""
    check_output("FILE", file)
    if file.suffix not in (".png", ".geojson"):
        raise UsageError(f"{file} must end in .png or .geojson")
    import msgspec

    from mapserver.serving.expected_views import SurfelChanges
    from mapserver.store import MapStore
    from mapserver.surfels.changes import APPEARED, CELL_M, VANISHED, changes_geojson, changes_png

    with MapStore.open(store, read_only=True) as maps:
        found = SurfelChanges(maps).between(site, before, after)
    data = changes_png(found) if file.suffix == ".png" else msgspec.json.encode(changes_geojson(found))
    with disk_errors(f"{file} cannot be written", "choose another place"):
        file.write_bytes(data)
    x, y = found.corner_m
    said = ", ".join(
        f"{sum(patch.kind == kind for patch in found.patches)} patches {kind} ({found.area_m2(kind):.2f} m2)"
        for kind in (APPEARED, VANISHED)
    )
    typer.echo(
        f"site {site}, version {before} to {after}: {said}; {file} has them"
        + (f", its lower left corner at ({x:.2f}, {y:.2f}) m, {CELL_M} m a pixel" if file.suffix == ".png" else "")
    )


MAP = Group("What a version knows of how its site looks.", {"splats": splats, "changes": changes})
